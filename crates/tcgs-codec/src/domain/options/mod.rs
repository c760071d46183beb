//! Training options. [`TRAIN_OPTIONS`] is the only list of them: the command line, the query string and JSON are read by it.

mod check;
mod kind;
mod table;
#[cfg(test)]
mod tests;
mod values;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use kind::OptionKind;
pub use table::{TRAIN_OPTIONS, TrainOption};
pub use values::{Background, Component, ModelKind, Preset, Until, Voxel};

use super::{
    CameraModel, CameraSearchOptions, Crop, ExifOrientation, Exposure, HoldOut, MaskMode, MaskSource,
    Matching, MaxWidth, ReadOptions,
};

/// Largest seed: the largest whole number that readers of JSON represent exactly if they use 64-bit floats, as JavaScript's do.
pub const MAX_SEED: u64 = (1 << 53) - 1;
/// Most iterations of a run.
pub const MAX_ITERATIONS: u32 = 1_000_000;

/// Most points of a rate-distortion curve.
pub const MAX_CURVE_POINTS: usize = 8;

/// Most Gaussians that a run may be asked for.
pub const MAX_GAUSSIANS: u32 = 100_000_000;

/// An option value that is not understood or not possible.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{option}: {error}")]
pub struct OptionError {
    /// Name of the option, as in the query string.
    pub option: &'static str,
    /// What is wrong and what would be right.
    pub error: String,
}

impl OptionError {
    fn new(option: &'static str, error: impl Into<String>) -> Self {
        Self { option, error: error.into() }
    }
}

/// Everything that decides a training run besides the dataset and the adapter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainOptions {
    /// Schedule.
    pub preset: Preset,
    /// Steps; the preset's own number if absent.
    pub iterations: Option<u32>,
    /// An option of earlier versions, without effect; serialized only where they did.
    #[serde(skip_serializing_if = "is_default")]
    pub until: Until,
    /// Seed of every random choice.
    pub seed: u64,
    /// Background of the renders and of images with alpha.
    pub background: Background,
    /// What is trained.
    pub model: ModelKind,
    /// How large a cell of the anchors' lattice is.
    pub voxel: Voxel,
    /// Parts of the method that are off.
    pub without: BTreeSet<Component>,
    /// Parts that are on in runs that leave them out by default; serialized only if there are some.
    #[serde(skip_serializing_if = "BTreeSet::is_empty")]
    pub with: BTreeSet<Component>,
    /// Weight of the rate term; the preset's own if absent.
    pub lambda: Option<f64>,
    /// Target size of the written file: the most bytes that it may have.
    pub max_bytes: Option<u64>,
    /// Number of Gaussians that a plain model is pruned to; serialized only if it is set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target_gaussians: Option<u32>,
    /// Number of Gaussians that a plain model does not grow beyond; serialized only if it is set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gaussians: Option<u32>,
    /// Weights of the rate term, each for a branch of the run with its own file; empty for one run and one file.
    pub rd_curve: Vec<f64>,
    /// Whether photographs are turned as their EXIF orientation says; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub exif_orientation: ExifOrientation,
    /// Where masks are; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub masks: MaskSource,
    /// What masks and transparency mean; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub mask_mode: MaskMode,
    /// Whether listed photographs that are missing are left out; serialized only if they are.
    #[serde(skip_serializing_if = "is_default")]
    pub skip_missing: bool,
    /// Which photographs are held out; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub holdout: HoldOut,
    /// The width to which wider photographs are downscaled; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub max_width: MaxWidth,
    /// Whether each photograph has a color correction of its own; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub exposure: Exposure,
    /// The region that the finished scene keeps; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub crop: Crop,
    /// The model of cameras that are found before training; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub camera_model: CameraModel,
    /// Which photographs are compared to find cameras; serialized only if it is stated.
    #[serde(skip_serializing_if = "is_default")]
    pub matching: Matching,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl Default for TrainOptions {
    fn default() -> Self {
        Self {
            preset: Preset::Preview,
            iterations: None,
            until: Until::Full,
            seed: 0,
            background: Background::Black,
            model: ModelKind::Tcgs,
            voxel: Voxel::Auto,
            without: BTreeSet::new(),
            with: BTreeSet::new(),
            lambda: None,
            max_bytes: None,
            target_gaussians: None,
            max_gaussians: None,
            rd_curve: Vec::new(),
            exif_orientation: ExifOrientation::Auto,
            masks: MaskSource::Auto,
            mask_mode: MaskMode::Auto,
            skip_missing: false,
            holdout: HoldOut::Auto,
            max_width: MaxWidth::default(),
            exposure: Exposure::Auto,
            crop: Crop::None,
            camera_model: CameraModel::SimpleRadial,
            matching: Matching::Auto,
        }
    }
}

impl TrainOptions {
    /// How the dataset is read.
    #[must_use]
    pub fn reading(&self) -> ReadOptions {
        let Self { exif_orientation, masks, mask_mode, skip_missing, holdout, max_width, .. } = self;
        ReadOptions {
            exif_orientation: *exif_orientation,
            masks: masks.clone(),
            mask_mode: *mask_mode,
            skip_missing: *skip_missing,
            holdout: *holdout,
            max_width: *max_width,
        }
    }

    /// Those that training itself depends on, besides its dataset: the others have their defaults.
    #[must_use]
    pub fn of_training(&self) -> Self {
        let Self { crop, camera_model, matching, .. } = Self::default();
        Self { crop, camera_model, matching, ..self.clone() }
    }

    /// How cameras are found, if the dataset has none: another search may find others.
    #[must_use]
    pub fn camera_search(&self) -> CameraSearchOptions {
        let Self { camera_model, matching, masks, mask_mode, .. } = self;
        let masks = if *mask_mode == MaskMode::CutOut { MaskSource::None } else { masks.clone() };
        CameraSearchOptions { camera_model: *camera_model, matching: *matching, masks }
    }

    /// Whether a part of the method takes part: the baselines have none of them.
    #[must_use]
    pub fn has(&self, part: Component) -> bool {
        self.model == ModelKind::Tcgs && !self.without.contains(&part)
    }

    /// Whether the parts are those that such a run has by itself.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        self.without.is_empty() && self.with.is_empty()
    }

    /// The options of the branches of a rate-distortion curve, in order: those of single runs with one weight each. A run
    /// without a curve is its own only branch.
    #[must_use]
    pub fn branches(&self) -> Vec<Self> {
        if self.rd_curve.is_empty() {
            return vec![self.clone()];
        }
        let branch = |lambda: &f64| Self { lambda: Some(*lambda), rd_curve: Vec::new(), ..self.clone() };
        self.rd_curve.iter().map(branch).collect()
    }
}
