//! Training options. [`TRAIN_OPTIONS`] is the only list of them: the command line, the query string and JSON are read by it.

use std::{collections::BTreeSet, fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use thiserror::Error;

use super::{
    CameraModel, CameraSearchOptions, Crop, ExifOrientation, Exposure, HoldOut, MaskMode, MaskSource,
    Matching, MaxWidth, ReadOptions, choice::named_choice,
};

/// Largest seed: the largest whole number that readers of JSON represent exactly if they use 64-bit floats, as JavaScript's do.
pub const MAX_SEED: u64 = (1 << 53) - 1;
/// Most iterations of a run.
pub const MAX_ITERATIONS: u32 = 1_000_000;

/// Most points of a rate-distortion curve.
pub const MAX_CURVE_POINTS: usize = 8;

/// Most Gaussians that a run may be asked for.
pub const MAX_GAUSSIANS: u32 = 100_000_000;

/// Why `until=converged` is refused.
const UNTIL_REMOVED: &str = "runs no longer end early, since no trial of it saved a step; leave it out, and set iterations for a shorter run";

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

named_choice! {
    /// A schedule: how many steps, how large a model.
    pub enum Preset {
        /// Minutes on a software adapter.
        Preview = "preview",
        /// For a GPU.
        Standard = "standard",
        /// 30 000 steps, as published.
        Paper = "paper",
    }
}

named_choice! {
    /// The color behind the scene.
    pub enum Background {
        /// (1, 1, 1).
        White = "white",
        /// (0, 0, 0).
        Black = "black",
    }
}

impl Background {
    /// As 8-bit RGB.
    #[must_use]
    pub fn rgb8(self) -> [u8; 3] {
        match self {
            Background::White => [255; 3],
            Background::Black => [0; 3],
        }
    }

    /// As RGB in [0, 1].
    #[must_use]
    pub fn rgb(self) -> [f32; 3] {
        self.rgb8().map(|value| f32::from(value) / 255.0)
    }
}

named_choice! {
    /// What is trained.
    pub enum ModelKind {
        /// Anchors with compression-aware training, written as `.tcgs`.
        Tcgs = "tcgs",
        /// The Scaffold-GS baseline.
        Scaffold = "scaffold",
        /// The plain 3D Gaussian splatting baseline.
        Gaussians3d = "3dgs",
    }
}

named_choice! {
    /// A part of the method that can be switched off.
    pub enum Component {
        /// The tri-plane context.
        TriPlane = "triplane",
        /// The neighbors' context.
        Knn = "knn",
        /// The planes' down and up sampling, a part of runs of 30 000 steps and more only, if not asked for.
        PlaneCompression = "plane-compression",
        /// The wavelet constraint.
        Wavelet = "wavelet",
        /// The offset masks.
        Masks = "masks",
        /// The decorrelating transform of features, and the removal of channels and offset slots that no picture needs.
        Basis = "basis",
        /// The regression of an anchor's attributes on each other in the file.
        Regression = "regression",
    }
}

named_choice! {
    /// When a run ends: after all of its steps.
    #[derive(Default)]
    pub enum Until {
        /// After all of its steps.
        #[default]
        Full = "full",
        /// The same. Jobs, checkpoints and files of earlier versions, which could end a run early, still say so.
        Converged = "converged",
    }
}

/// How large a cell of the anchors' lattice is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Voxel {
    /// A fraction of the points' spacing: right whatever the unit of the scene.
    #[default]
    Auto,
    /// As the published code chooses it: a squared distance taken for a length (METHOD.md §2.1).
    Published,
    /// So many world units.
    #[serde(untagged)]
    Edge(f64),
}

impl fmt::Display for Voxel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Voxel::Auto => f.write_str("auto"),
            Voxel::Published => f.write_str("published"),
            Voxel::Edge(edge) => edge.fmt(f),
        }
    }
}

impl FromStr for Voxel {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Voxel::Auto),
            "published" => Ok(Voxel::Published),
            _ => text
                .parse()
                .map(Voxel::Edge)
                .map_err(|_| format!("'{text}' is not auto, published or a length")),
        }
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

/// Whether a number stays positive and normal in single precision.
fn is_positive(value: f64) -> bool {
    value.is_finite() && value > 0.0 && (value as f32).is_normal()
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

    /// Checks that the options can be carried out by this version.
    ///
    /// # Errors
    /// [`OptionError`] naming the option and why.
    pub fn validated(self) -> Result<Self, OptionError> {
        if let Some(iterations) = self.iterations
            && !(1..=MAX_ITERATIONS).contains(&iterations)
        {
            return Err(OptionError::new(
                "iterations",
                format!("{iterations} is outside 1..={MAX_ITERATIONS}"),
            ));
        }
        if self.until != Until::Full {
            return Err(OptionError::new("until", UNTIL_REMOVED.to_owned()));
        }
        self.check_voxel()?;
        if let Some(lambda) = self.lambda {
            if !is_positive(lambda) {
                return Err(OptionError::new("lambda", format!("{lambda} is not a positive weight")));
            }
            if self.model != ModelKind::Tcgs {
                let error = format!("model '{}' has no rate term to weigh", self.model);
                return Err(OptionError::new("lambda", error));
            }
        }
        self.check_without()?;
        self.check_with()?;
        self.check_max_bytes()?;
        self.check_gaussians()?;
        self.check_rd_curve()?;
        self.crop.check().map_err(|error| OptionError::new("crop", error.to_string()))?;
        Ok(self)
    }

    fn check_voxel(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("voxel", text));
        match self.voxel {
            Voxel::Edge(edge) if !is_positive(edge) => error(format!("{edge} is not a positive length")),
            Voxel::Edge(_) | Voxel::Published if self.model == ModelKind::Gaussians3d => {
                error(format!("the model {} has no lattice", self.model))
            }
            _ => Ok(()),
        }
    }

    fn check_without(&self) -> Result<(), OptionError> {
        // Planes that are not compressed are true of every model.
        match self.without.iter().find(|part| **part != Component::PlaneCompression) {
            Some(part) if self.model != ModelKind::Tcgs => Err(OptionError::new(
                "without",
                format!("the model {} has no {part} to leave out", self.model),
            )),
            _ => Ok(()),
        }
    }

    fn check_with(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("plane_compression", text));
        match self.with.first() {
            None => Ok(()),
            Some(part) if self.with.len() > 1 || *part != Component::PlaneCompression => {
                error("no other part of the method is optional".to_owned())
            }
            Some(part) if !self.has(*part) || !self.has(Component::TriPlane) => {
                error(format!("the model {} has no planes to compress, or they are switched off", self.model))
            }
            Some(_) => Ok(()),
        }
    }

    fn check_max_bytes(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("max_bytes", text));
        match self.max_bytes {
            None => Ok(()),
            Some(_) if self.model != ModelKind::Tcgs => {
                error(format!("the model {} has no target size: it is written as floats", self.model))
            }
            Some(_) if !self.rd_curve.is_empty() => {
                error("is for one file, rd_curve for several; leave out one of them".to_owned())
            }
            Some(_) => Ok(()),
        }
    }

    fn check_gaussians(&self) -> Result<(), OptionError> {
        let (target, max) = (self.target_gaussians, self.max_gaussians);
        for (option, number) in [("target_gaussians", target), ("max_gaussians", max)] {
            let error = |text: String| Err(OptionError::new(option, text));
            match number {
                None => {}
                Some(number) if !(1..=MAX_GAUSSIANS).contains(&number) => {
                    return error(format!("{number} is outside 1..={MAX_GAUSSIANS}"));
                }
                Some(_) if self.model != ModelKind::Gaussians3d => {
                    return error(format!("is for the model 3dgs; {} has anchors", self.model));
                }
                Some(_) => {}
            }
        }
        match (target, max) {
            (Some(target), Some(max)) if target > max => Err(OptionError::new(
                "target_gaussians",
                format!("{target} are more than the {max} that max_gaussians allows"),
            )),
            _ => Ok(()),
        }
    }

    fn check_rd_curve(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("rd_curve", text));
        let curve = &self.rd_curve;
        if curve.is_empty() {
            return Ok(());
        }
        if self.model != ModelKind::Tcgs {
            return error(format!("the model {} has no rate to weigh", self.model));
        }
        if self.lambda.is_some() {
            return error("each of its points has its own lambda; leave out lambda or rd_curve".to_owned());
        }
        if curve.len() > MAX_CURVE_POINTS {
            return error(format!("{} points are more than {MAX_CURVE_POINTS}", curve.len()));
        }
        for (index, lambda) in curve.iter().enumerate() {
            if !is_positive(*lambda) {
                return error(format!("{lambda} is not a positive weight"));
            }
            if curve[..index].contains(lambda) {
                return error(format!("{lambda} is given twice"));
            }
        }
        Ok(())
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

/// What an option's value is, and its bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OptionKind {
    /// One of these names.
    Choice(&'static [&'static str]),
    /// A set of these names, separated by commas.
    Choices(&'static [&'static str]),
    /// A whole number from the first to the second.
    Integer(u64, u64),
    /// A whole number of bytes, which the command line also takes with a unit.
    Bytes,
    /// A positive number.
    Positive,
    /// At most this number of different positive numbers, separated by commas, perhaps in brackets.
    Positives(usize),
    /// One of these names, or a positive number.
    ChoiceOrPositive(&'static [&'static str]),
    /// One of these names, or the path of a folder in the dataset.
    ChoiceOrFolder(&'static [&'static str]),
    /// One of these names, or six numbers separated by commas: two corners of a box.
    ChoiceOrBox(&'static [&'static str]),
    /// True or false.
    Switch,
}

impl fmt::Display for OptionKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            OptionKind::Choice(names) => write!(f, "one of {}", names.join(", ")),
            OptionKind::Choices(names) => write!(f, "a list of {}", names.join(", ")),
            OptionKind::Integer(min, max) => write!(f, "a whole number in {min}..={max}"),
            OptionKind::Bytes => f.write_str("a whole number of bytes"),
            OptionKind::Positive => f.write_str("a positive number"),
            OptionKind::Positives(max) => write!(f, "a list of at most {max} positive numbers"),
            OptionKind::ChoiceOrPositive(names) => write!(f, "{} or a positive number", names.join(", ")),
            OptionKind::ChoiceOrFolder(names) => {
                write!(f, "{} or the path of a folder in the dataset", names.join(", "))
            }
            OptionKind::ChoiceOrBox(names) => {
                write!(f, "{} or a box x0,y0,z0,x1,y1,z1", names.join(", "))
            }
            OptionKind::Switch => f.write_str("true or false"),
        }
    }
}

impl OptionKind {
    fn is_list(self) -> bool {
        matches!(self, OptionKind::Choices(_) | OptionKind::Positives(_))
    }

    /// A value of this kind in JSON as it would stand in a query string; `None` for a value of another kind.
    fn text_of(self, value: &Value) -> Option<String> {
        let one = |value: &Value| match (self, value) {
            (
                OptionKind::Choice(_)
                | OptionKind::Choices(_)
                | OptionKind::ChoiceOrFolder(_)
                | OptionKind::ChoiceOrBox(_),
                Value::String(text),
            ) => Some(text.clone()),
            (OptionKind::ChoiceOrPositive(names), Value::String(text)) => {
                names.contains(&text.as_str()).then(|| text.clone())
            }
            (OptionKind::Switch, Value::Bool(value)) => Some(value.to_string()),
            (
                OptionKind::Choice(_)
                | OptionKind::Choices(_)
                | OptionKind::ChoiceOrFolder(_)
                | OptionKind::ChoiceOrBox(_)
                | OptionKind::Switch,
                _,
            ) => None,
            (_, Value::Number(number)) => Some(number.to_string()),
            _ => None,
        };
        match value {
            Value::Array(items) if self.is_list() && !items.is_empty() => {
                // An empty name would be left out, and one with a comma in it would become two.
                let item = |value| one(value).filter(|text| !text.is_empty() && !text.contains(','));
                items.iter().map(item).collect::<Option<Vec<_>>>().map(|items| items.join(","))
            }
            Value::String(text) if self.is_list() => Some(text.clone()),
            _ if self.is_list() => None,
            value => one(value),
        }
    }
}

/// A row of [`TRAIN_OPTIONS`].
#[derive(Debug)]
pub struct TrainOption {
    /// Its name in the query string and in JSON; the command line's flag has hyphens for underscores.
    pub name: &'static str,
    /// What it takes.
    pub kind: OptionKind,
    /// What an absent option means, where that is a value.
    pub default: Option<&'static str>,
    /// One sentence for `--help`; none for an earlier name, which the API alone still takes.
    pub help: Option<&'static str>,
    /// `None` where the text is not of this kind.
    set: fn(&mut TrainOptions, &str) -> Option<()>,
}

impl TrainOption {
    /// The option of that name.
    #[must_use]
    pub fn named(name: &str) -> Option<&'static Self> {
        TRAIN_OPTIONS.iter().find(|row| row.name == name)
    }

    /// Sets the option from its text in a query string or after a flag; lists are separated by commas.
    ///
    /// # Errors
    /// [`OptionError`] for a value of another kind.
    pub fn set(&self, options: &mut TrainOptions, text: &str) -> Result<(), OptionError> {
        (self.set)(options, text).ok_or_else(|| self.mismatch(format_args!("'{}'", shown(text))))
    }

    /// Sets the option from its value in JSON: a number, a name, or for a list also an array. `null` leaves an option unset that has
    /// no default.
    ///
    /// # Errors
    /// As [`Self::set`].
    pub fn set_json(&self, options: &mut TrainOptions, value: &Value) -> Result<(), OptionError> {
        match self.kind.text_of(value) {
            Some(text) => self.set(options, &text),
            None if value.is_null() && self.is_nullable() => Ok(()),
            None if value.as_array().is_some_and(Vec::is_empty) && self.kind.is_list() => Ok(()),
            None => Err(self.mismatch(format_args!("{}", shown(&value.to_string())))),
        }
    }

    fn mismatch(&self, value: fmt::Arguments<'_>) -> OptionError {
        OptionError::new(self.name, format!("{value} is not {}", self.kind))
    }

    /// Whether JSON may say `null` for an absent value.
    #[must_use]
    pub fn is_nullable(&self) -> bool {
        self.default.is_none() && !self.kind.is_list()
    }
}

/// Every option of a training run. The command line's flags, the query string and JSON are read by it, and a test holds `openapi.yaml`
/// to it.
pub static TRAIN_OPTIONS: [TrainOption; 25] = [
    TrainOption {
        name: "preset",
        kind: OptionKind::Choice(Preset::NAMES),
        default: Some("preview"),
        help: Some("Schedule: preview for a software adapter, standard for a GPU, paper as published"),
        set: |options, text| text.parse().ok().map(|preset| options.preset = preset),
    },
    TrainOption {
        name: "iterations",
        kind: OptionKind::Integer(1, MAX_ITERATIONS as u64),
        default: None,
        help: Some("Training iterations [default: the preset's]"),
        set: |options, text| text.parse().ok().map(|steps| options.iterations = Some(steps)),
    },
    TrainOption {
        name: "until",
        kind: OptionKind::Choice(&["full"]),
        default: Some("full"),
        help: None,
        set: |options, text| text.parse().ok().map(|until| options.until = until),
    },
    TrainOption {
        name: "seed",
        kind: OptionKind::Integer(0, MAX_SEED),
        default: Some("0"),
        help: Some("Seed of all random numbers"),
        set: |options, text| {
            text.parse().ok().filter(|seed| *seed <= MAX_SEED).map(|seed| options.seed = seed)
        },
    },
    TrainOption {
        name: "background",
        kind: OptionKind::Choice(Background::NAMES),
        default: Some("black"),
        help: Some("Background of renders and of images with alpha"),
        set: |options, text| text.parse().ok().map(|background| options.background = background),
    },
    TrainOption {
        name: "model",
        kind: OptionKind::Choice(ModelKind::NAMES),
        default: Some("tcgs"),
        help: Some("Model to train: tcgs, or one of its baselines"),
        set: |options, text| text.parse().ok().map(|model| options.model = model),
    },
    TrainOption {
        name: "voxel",
        kind: OptionKind::ChoiceOrPositive(&["auto", "published"]),
        default: Some("auto"),
        help: Some(
            "Edge of a voxel of the anchor lattice: auto (from the spacing of the points), published (the paper's rule), or a length in world units",
        ),
        set: |options, text| text.parse().ok().map(|voxel| options.voxel = voxel),
    },
    TrainOption {
        name: "without",
        kind: OptionKind::Choices(Component::NAMES),
        default: None,
        help: Some("Parts of the method to switch off"),
        set: |options, text| {
            names(text).try_for_each(|name| name.parse().ok().map(|part| _ = options.without.insert(part)))
        },
    },
    TrainOption {
        name: "plane_compression",
        kind: OptionKind::Choice(&["auto", "on", "off"]),
        default: Some("auto"),
        help: Some(
            "Down- and upsampling of the context planes: auto switches it on for 30000 iterations and more",
        ),
        set: |options, text| {
            match text {
                "auto" => {}
                "on" => _ = options.with.insert(Component::PlaneCompression),
                "off" => _ = options.without.insert(Component::PlaneCompression),
                _ => return None,
            }
            Some(())
        },
    },
    // As jobs and files store `plane_compression=on`, and earlier clients send it.
    TrainOption {
        name: "with",
        kind: OptionKind::Choices(&["plane-compression"]),
        default: None,
        help: None,
        set: |options, text| {
            names(text).try_for_each(|name| {
                let part = name.parse().ok().filter(|part| *part == Component::PlaneCompression)?;
                options.with.insert(part);
                Some(())
            })
        },
    },
    TrainOption {
        name: "lambda",
        kind: OptionKind::Positive,
        default: None,
        help: Some(
            "Weight of the file's size in the loss; larger makes smaller files [default: the preset's]",
        ),
        set: |options, text| text.parse().ok().map(|weight| options.lambda = Some(weight)),
    },
    TrainOption {
        name: "max_bytes",
        kind: OptionKind::Bytes,
        default: None,
        help: Some("Largest size of the file: coarser quantization and pruning make it fit"),
        set: |options, text| text.parse().ok().map(|bytes| options.max_bytes = Some(bytes)),
    },
    TrainOption {
        name: "target_gaussians",
        kind: OptionKind::Integer(1, MAX_GAUSSIANS as u64),
        default: None,
        help: Some(
            "For the model 3dgs: train more Gaussians, prune them to this number by what the training views lose, train on",
        ),
        set: |options, text| text.parse().ok().map(|number| options.target_gaussians = Some(number)),
    },
    TrainOption {
        name: "max_gaussians",
        kind: OptionKind::Integer(1, MAX_GAUSSIANS as u64),
        default: None,
        help: Some(
            "For the model 3dgs: grow to no more than this number of Gaussians [default: the preset's]",
        ),
        set: |options, text| text.parse().ok().map(|number| options.max_gaussians = Some(number)),
    },
    TrainOption {
        name: "rd_curve",
        kind: OptionKind::Positives(MAX_CURVE_POINTS),
        default: None,
        help: Some(
            "Values of lambda, each for a file of its own: training is shared up to where lambda matters",
        ),
        set: |options, text| {
            let list = text.strip_prefix('[').and_then(|list| list.strip_suffix(']')).unwrap_or(text);
            let weights: Option<_> = list.split(',').map(|text| text.trim().parse().ok()).collect();
            weights.map(|weights| options.rd_curve = weights)
        },
    },
    TrainOption {
        name: "exif_orientation",
        kind: OptionKind::Choice(ExifOrientation::NAMES),
        default: Some("auto"),
        help: Some(
            "EXIF orientation of photographs: auto applies it where cameras and points agree with the turned pixels",
        ),
        set: |options, text| text.parse().ok().map(|orientation| options.exif_orientation = orientation),
    },
    TrainOption {
        name: "masks",
        kind: OptionKind::ChoiceOrFolder(&["auto", "none"]),
        default: Some("auto"),
        help: Some("Masks of photographs: auto finds them by their names; none reads photographs whole"),
        set: |options, text| text.parse().ok().map(|masks| options.masks = masks),
    },
    TrainOption {
        name: "mask_mode",
        kind: OptionKind::Choice(MaskMode::NAMES),
        default: Some("auto"),
        help: Some(
            "What masks and transparency mean: auto ignores what masks hide and cuts out what is transparent",
        ),
        set: |options, text| text.parse().ok().map(|mode| options.mask_mode = mode),
    },
    TrainOption {
        name: "skip_missing",
        kind: OptionKind::Switch,
        default: Some("false"),
        help: Some("Leave listed photographs that are missing out, rather than refuse the dataset"),
        set: |options, text| text.parse().ok().map(|skip| options.skip_missing = skip),
    },
    TrainOption {
        name: "holdout",
        kind: OptionKind::Choice(HoldOut::NAMES),
        default: Some("auto"),
        help: Some(
            "Photographs to hold out: auto (the layout's own test views, else every eighth) or a sector of neighboring cameras",
        ),
        set: |options, text| text.parse().ok().map(|holdout| options.holdout = holdout),
    },
    TrainOption {
        name: "max_width",
        kind: OptionKind::Integer(MaxWidth::MIN as u64, MaxWidth::MAX as u64),
        default: Some("1600"),
        help: Some(
            "Width in pixels to which wider photographs are downscaled, for training and held-out views alike",
        ),
        set: |options, text| text.parse().ok().map(|width| options.max_width = width),
    },
    TrainOption {
        name: "exposure",
        kind: OptionKind::Choice(Exposure::NAMES),
        default: Some("auto"),
        help: Some(
            "Learn a color correction for each photograph: auto does if training views that are set aside gain by it",
        ),
        set: |options, text| text.parse().ok().map(|exposure| options.exposure = exposure),
    },
    TrainOption {
        name: "crop",
        kind: OptionKind::ChoiceOrBox(&["none", "cameras"]),
        default: Some("none"),
        help: Some(
            "Keep a part of the finished scene: what at least half of the training cameras have in view (cameras), or a box x0,y0,z0,x1,y1,z1 in the dataset's world",
        ),
        set: |options, text| text.parse().ok().map(|crop| options.crop = crop),
    },
    TrainOption {
        name: "camera_model",
        kind: OptionKind::Choice(CameraModel::NAMES),
        default: Some("simple-radial"),
        help: Some(
            "COLMAP's model of cameras that are found first, of photographs without them; other datasets state theirs",
        ),
        set: |options, text| text.parse().ok().map(|model| options.camera_model = model),
    },
    TrainOption {
        name: "matching",
        kind: OptionKind::Choice(Matching::NAMES),
        default: Some("auto"),
        help: Some(
            "Photographs without cameras that are compared to find them: exhaustive (all pairs), sequential (neighbors by name), auto (all pairs of up to 200)",
        ),
        set: |options, text| text.parse().ok().map(|matching| options.matching = matching),
    },
];

/// As much of a value as a message repeats.
fn shown(value: &str) -> String {
    value.chars().take(100).collect()
}

/// The names of a list.
fn names(text: &str) -> impl Iterator<Item = &str> {
    text.split(',').filter(|name| !name.is_empty())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn set_option(options: &mut TrainOptions, name: &str, text: &str) -> Result<(), OptionError> {
        TrainOption::named(name).expect("an option").set(options, text)
    }

    /// The options that are set by these names and values, checked.
    fn validated(pairs: &[(&str, &str)]) -> Result<TrainOptions, OptionError> {
        let mut options = TrainOptions::default();
        pairs.iter().for_each(|(name, value)| set_option(&mut options, name, value).expect("parses"));
        options.validated()
    }

    #[test]
    fn options_are_set_by_name_and_faults_name_the_option() {
        let mut options = TrainOptions::default();
        set_option(&mut options, "preset", "standard").expect("a preset");
        set_option(&mut options, "iterations", "1500").expect("a number");
        set_option(&mut options, "background", "white").expect("a background");
        assert_eq!(options.preset, Preset::Standard);
        assert_eq!(options.iterations, Some(1500));
        let error = set_option(&mut options, "preset", "fast").expect_err("no such preset");
        assert_eq!(error.to_string(), "preset: 'fast' is not one of preview, standard, paper");
        assert!(set_option(&mut options, "seed", "-1").is_err());
        assert!(TrainOption::named("color").is_none());
    }

    #[test]
    fn every_field_has_its_row_with_its_default() {
        let with = Component::ALL.iter().copied().collect();
        let exif_orientation = ExifOrientation::Ignore;
        let (masks, mask_mode) = (MaskSource::None, MaskMode::Ignore);
        let stated = TrainOptions {
            exif_orientation,
            masks,
            mask_mode,
            skip_missing: true,
            holdout: HoldOut::Sector,
            max_width: MaxWidth::new(400).expect("a width"),
            target_gaussians: Some(1),
            max_gaussians: Some(1),
            exposure: Exposure::On,
            crop: Crop::Cameras,
            camera_model: CameraModel::Opencv,
            matching: Matching::Exhaustive,
            ..TrainOptions::default()
        };
        let all = TrainOptions { with, until: Until::Converged, ..stated };
        let fields = serde_json::to_value(all).expect("JSON");
        let fields: BTreeSet<&str> =
            fields.as_object().expect("an object").keys().map(String::as_str).collect();
        let rows = TRAIN_OPTIONS.iter().map(|row| row.name).filter(|name| *name != "plane_compression");
        assert_eq!(fields, rows.collect());
        for row in &TRAIN_OPTIONS {
            let mut options = TrainOptions::default();
            row.default.into_iter().for_each(|text| row.set(&mut options, text).expect("a value"));
            assert_eq!(options, TrainOptions::default(), "{}", row.name);
            let error = row.set(&mut options, "?").expect_err("no value");
            assert_eq!(error.to_string(), format!("{}: '?' is not {}", row.name, row.kind));
        }
    }

    #[test]
    fn json_has_numbers_names_and_lists_of_them() {
        let set = |name: &str, value: serde_json::Value| {
            let mut options = TrainOptions::default();
            TrainOption::named(name).expect("an option").set_json(&mut options, &value).map(|()| options)
        };
        let with_lists = set("without", json!(["masks", "knn"])).expect("parts");
        assert_eq!(with_lists.without, [Component::Knn, Component::Masks].into());
        assert_eq!(set("rd_curve", json!([0.004, 1e-3])).expect("weights").rd_curve, [0.004, 0.001]);
        assert_eq!(set("rd_curve", json!("0.004,1e-3")).expect("weights").rd_curve, [0.004, 0.001]);
        assert_eq!(set("voxel", json!(0.1)).expect("a length").voxel, Voxel::Edge(0.1));
        for (name, value) in [("lambda", json!(null)), ("without", json!([])), ("rd_curve", json!([]))] {
            assert_eq!(set(name, value).expect("absent"), TrainOptions::default());
        }
        for (name, value) in [
            ("iterations", json!("7")),
            ("iterations", json!(1.5)),
            ("seed", json!(null)),
            ("voxel", json!("0.5")),
            ("lambda", json!(true)),
            ("without", json!(null)),
            ("without", json!(["masks,knn"])),
            ("without", json!([""])),
            ("rd_curve", json!(["0.1"])),
            ("rd_curve", json!(0.1)),
        ] {
            let error = set(name, value.clone()).expect_err("another kind");
            assert!(error.option == name && error.error.contains(&value.to_string()), "{name}: {error}");
        }
    }

    #[test]
    fn compressed_planes_are_automatic_on_or_off() {
        let set = |text: &str| {
            let mut options = TrainOptions::default();
            set_option(&mut options, "plane_compression", text).map(|()| options)
        };
        assert_eq!(set("auto"), Ok(TrainOptions::default()));
        assert_eq!(set("on").expect("on").with, [Component::PlaneCompression].into());
        assert!(!set("off").expect("off").has(Component::PlaneCompression));
        let mut both = set("on").expect("on");
        set_option(&mut both, "without", "plane-compression").expect("a part");
        assert_eq!(both.validated().expect_err("a contradiction").option, "plane_compression");
    }

    #[test]
    fn a_part_is_on_in_the_method_and_off_in_the_baselines_and_where_it_is_left_out() {
        let mut options = TrainOptions::default();
        assert!(options.has(Component::Wavelet));
        set_option(&mut options, "without", "wavelet").expect("a part");
        let options = options.validated().expect("this version has it");
        assert!(!options.has(Component::Wavelet) && options.has(Component::Masks));
        for model in [ModelKind::Scaffold, ModelKind::Gaussians3d] {
            let baseline = TrainOptions { model, ..TrainOptions::default() };
            assert!(!baseline.has(Component::Wavelet));
        }
    }

    #[test]
    fn options_that_a_model_has_no_use_for_are_refused() {
        for (pairs, option) in [
            ([("model", "3dgs"), ("voxel", "0.1")], "voxel"),
            ([("model", "3dgs"), ("voxel", "published")], "voxel"),
            ([("model", "3dgs"), ("without", "masks")], "without"),
            ([("model", "scaffold"), ("without", "knn")], "without"),
        ] {
            assert_eq!(validated(&pairs).expect_err("of no use").option, option, "{pairs:?}");
        }
        for pairs in [
            [("model", "scaffold"), ("voxel", "0.1")],
            [("model", "3dgs"), ("voxel", "auto")],
            [("model", "3dgs"), ("plane_compression", "off")],
        ] {
            assert!(validated(&pairs).is_ok(), "{pairs:?}");
        }
    }

    #[test]
    fn runs_that_earlier_versions_could_end_early_are_read_and_new_ones_are_refused_with_the_reason() {
        let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
        assert!(usual.get("until").is_none());
        let stored = json!({ "until": "converged" });
        let options: TrainOptions = serde_json::from_value(stored).expect("stored options");
        assert_eq!(serde_json::to_value(&options).expect("JSON")["until"], "converged");
        let error = validated(&[("until", "converged")]).expect_err("no longer a choice");
        assert!(error.option == "until" && error.error.contains("iterations"), "{error}");
        assert_eq!(validated(&[("until", "full")]), Ok(TrainOptions::default()));
        let error = set_option(&mut TrainOptions::default(), "until", "soon").expect_err("no choice");
        assert_eq!(error.to_string(), "until: 'soon' is not one of full");
    }

    #[test]
    fn only_parts_that_are_off_by_default_can_be_switched_on() {
        let asked = |model, without: &[Component], with: &str| {
            let without = without.iter().copied().collect();
            let mut options = TrainOptions { model, without, ..TrainOptions::default() };
            set_option(&mut options, "with", with)?;
            options.validated()
        };
        let options = asked(ModelKind::Tcgs, &[], "plane-compression").expect("possible");
        assert_eq!(serde_json::to_value(&options).expect("JSON")["with"], json!(["plane-compression"]));
        let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
        assert!(usual.get("with").is_none(), "it is not serialized unless set");
        for (error, option) in [
            (asked(ModelKind::Tcgs, &[], "masks"), "with"),
            (asked(ModelKind::Tcgs, &[], "hope"), "with"),
            (
                asked(ModelKind::Tcgs, &[Component::PlaneCompression], "plane-compression"),
                "plane_compression",
            ),
            (asked(ModelKind::Tcgs, &[Component::TriPlane], "plane-compression"), "plane_compression"),
            (asked(ModelKind::Scaffold, &[], "plane-compression"), "plane_compression"),
        ] {
            assert_eq!(error.expect_err("refused").option, option);
        }
        let stored: TrainOptions = serde_json::from_value(json!({ "with": ["masks"] })).expect("options");
        assert_eq!(stored.validated().expect_err("refused").option, "plane_compression");
    }

    #[test]
    fn a_voxel_is_a_rule_or_a_length_in_every_form() {
        for (text, voxel, json) in [
            ("auto", Voxel::Auto, "\"auto\""),
            ("published", Voxel::Published, "\"published\""),
            ("0.025", Voxel::Edge(0.025), "0.025"),
        ] {
            assert_eq!(text.parse(), Ok(voxel));
            assert_eq!(voxel.to_string(), text);
            assert_eq!(serde_json::to_string(&voxel).expect("JSON"), json);
            assert_eq!(serde_json::from_str::<Voxel>(json).expect("a voxel"), voxel);
            let options = TrainOptions { voxel, ..TrainOptions::default() };
            assert_eq!(options.clone().validated(), Ok(options));
        }
        for text in ["", "small", "0,1"] {
            assert_eq!(
                set_option(&mut TrainOptions::default(), "voxel", text).expect_err(text).option,
                "voxel"
            );
        }
        for edge in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-300, 1e300] {
            let options = TrainOptions { voxel: Voxel::Edge(edge), ..TrainOptions::default() };
            assert_eq!(options.validated().expect_err("no length").option, "voxel", "{edge}");
        }
    }

    #[test]
    fn a_region_is_checked_with_the_options() {
        let crop = validated(&[("crop", "-1,-1,-1,1,1,1")]).expect("possible").crop;
        assert_eq!(crop, Crop::Box([-1.0; 3], [1.0; 3]));
        for wrong in ["1,1,1,-1,-1,-1", "0,0,0,1,1,nan"] {
            assert_eq!(validated(&[("crop", wrong)]).expect_err(wrong).option, "crop");
        }
        let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
        for option in ["crop", "camera_model", "matching"] {
            assert!(usual.get(option).is_none(), "{option}");
        }
    }

    #[test]
    fn a_target_size_is_for_the_method_alone() {
        assert_eq!(validated(&[("max_bytes", "50000")]).expect("possible").max_bytes, Some(50_000));
        for wrong in [
            &[("max_bytes", "50000"), ("model", "scaffold")][..],
            &[("max_bytes", "50000"), ("model", "3dgs")],
            &[("max_bytes", "50000"), ("rd_curve", "0.001")],
        ] {
            assert_eq!(validated(wrong).expect_err("impossible").option, "max_bytes", "{wrong:?}");
        }
        for text in ["-1", "1e6", "5 MB", ""] {
            let error = set_option(&mut TrainOptions::default(), "max_bytes", text).expect_err(text);
            assert_eq!(error.option, "max_bytes");
        }
    }

    #[test]
    fn numbers_of_gaussians_are_for_plain_gaussians_alone() {
        let plain = ("model", "3dgs");
        let both =
            validated(&[plain, ("target_gaussians", "1000"), ("max_gaussians", "9000")]).expect("possible");
        assert_eq!((both.target_gaussians, both.max_gaussians), (Some(1000), Some(9000)));
        let json = serde_json::to_value(&both).expect("JSON");
        assert_eq!((&json["target_gaussians"], &json["max_gaussians"]), (&json!(1000), &json!(9000)));
        let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
        assert!(usual.get("target_gaussians").is_none() && usual.get("max_gaussians").is_none());
        for option in ["target_gaussians", "max_gaussians"] {
            for wrong in [&[(option, "0"), plain][..], &[(option, "100000001"), plain], &[(option, "1000")]] {
                assert_eq!(validated(wrong).expect_err("impossible").option, option, "{wrong:?}");
            }
        }
        let more = validated(&[plain, ("target_gaussians", "1000"), ("max_gaussians", "999")]);
        assert_eq!(more.expect_err("impossible").option, "target_gaussians");
    }

    #[test]
    fn a_curve_is_a_list_of_distinct_weights_in_the_order_given() {
        let curve = |text: &str| {
            let mut options = TrainOptions::default();
            set_option(&mut options, "rd_curve", text).and_then(|()| options.validated())
        };
        for text in ["0.004,0.0005,0.001", "[0.004, 0.0005, 1e-3]"] {
            let options = curve(text).expect("possible");
            assert_eq!(options.rd_curve, [0.004, 0.0005, 0.001]);
            let json = serde_json::to_string(&options).expect("JSON");
            assert_eq!(serde_json::from_str::<TrainOptions>(&json).expect("options"), options);
            let branches = options.branches();
            let lambdas: Vec<_> = branches.iter().map(|branch| branch.lambda).collect();
            assert_eq!(lambdas, [Some(0.004), Some(0.0005), Some(0.001)]);
            assert!(branches.iter().all(|branch| branch.rd_curve.is_empty()));
        }
        assert_eq!(TrainOptions::default().branches(), [TrainOptions::default()]);
        let nine: Vec<String> = (1..=9).map(|weight| weight.to_string()).collect();
        assert!(curve(&nine[..8].join(",")).is_ok());
        for wrong in [
            "",
            "0.001,",
            "[0.001",
            "0",
            "-1",
            "nan",
            "inf",
            "1e-3,1e39",
            "0.001,1e-3",
            "many",
            &nine.join(","),
        ] {
            assert_eq!(curve(wrong).expect_err(wrong).option, "rd_curve", "{wrong}");
        }
        let rd_curve = vec![0.001];
        for wrong in [
            TrainOptions { lambda: Some(0.1), rd_curve: rd_curve.clone(), ..TrainOptions::default() },
            TrainOptions { model: ModelKind::Scaffold, rd_curve, ..TrainOptions::default() },
        ] {
            assert!(wrong.validated().is_err());
        }
    }

    #[test]
    fn the_weight_of_the_rate_is_positive_and_the_methods_own() {
        for lambda in [1e-6, 0.001, 40.0] {
            let options = TrainOptions { lambda: Some(lambda), ..TrainOptions::default() };
            assert_eq!(options.clone().validated(), Ok(options.clone()));
            for model in [ModelKind::Scaffold, ModelKind::Gaussians3d] {
                let baseline = TrainOptions { model, ..options.clone() };
                assert_eq!(baseline.validated().expect_err("no rate term").option, "lambda");
            }
        }
        for lambda in [0.0, -0.001, f64::NAN, f64::INFINITY, 1e-300] {
            let options = TrainOptions { lambda: Some(lambda), ..TrainOptions::default() };
            assert_eq!(options.validated().expect_err("no weight").option, "lambda", "{lambda}");
        }
    }

    #[test]
    fn what_this_version_cannot_do_is_refused_not_ignored() {
        let mut options = TrainOptions::default();
        let parts: Vec<&str> = Component::ALL.iter().map(|part| part.name()).collect();
        set_option(&mut options, "without", &parts.join(",")).expect("parses");
        let options = options.validated().expect("every part can be left out");
        assert!(Component::ALL.iter().all(|part| !options.has(*part)));
        let zero = TrainOptions { iterations: Some(0), ..TrainOptions::default() };
        assert!(zero.validated().is_err());
    }
}
