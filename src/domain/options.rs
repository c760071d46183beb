//! Training options: the same names and meanings on the command line, in the query string and in JSON.

use std::{collections::BTreeSet, fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Largest number of steps that a job may ask for.
pub const MAX_ITERATIONS: u32 = 1_000_000;

/// An option value that is not understood or not possible.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{option}: {fault}")]
pub struct OptionError {
    /// Name of the option, as in the query string.
    pub option: &'static str,
    /// What is wrong and what would be right.
    pub fault: String,
}

impl OptionError {
    fn new(option: &'static str, fault: impl Into<String>) -> Self {
        Self { option, fault: fault.into() }
    }
}

macro_rules! named_choice {
    ($(#[$meta:meta])* $name:ident, $option:literal { $($(#[$variant_meta:meta])* $variant:ident = $text:literal),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub enum $name { $($(#[$variant_meta])* #[serde(rename = $text)] $variant),+ }

        impl $name {
            /// Every choice.
            pub const ALL: &[Self] = &[$(Self::$variant),+];

            /// The name that users write.
            #[must_use]
            pub fn name(self) -> &'static str {
                match self { $(Self::$variant => $text),+ }
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.name())
            }
        }

        impl FromStr for $name {
            type Err = OptionError;

            fn from_str(text: &str) -> Result<Self, OptionError> {
                Self::ALL.iter().copied().find(|choice| choice.name() == text).ok_or_else(|| {
                    let names: Vec<_> = Self::ALL.iter().map(|choice| choice.name()).collect();
                    OptionError::new($option, format!("'{text}' is not one of {}", names.join(", ")))
                })
            }
        }
    };
}

named_choice! {
    /// A schedule: how many steps, how large a model.
    Preset, "preset" {
        /// Minutes on a software adapter.
        Preview = "preview",
        /// For a GPU.
        Standard = "standard",
        /// 30 000 steps, as published.
        Paper = "paper",
    }
}

named_choice! {
    /// The colour behind the scene.
    Background, "background" {
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
    ModelKind, "model" {
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
    Component, "without" {
        /// The tri-plane context.
        TriPlane = "triplane",
        /// The neighbours' context.
        Knn = "knn",
        /// The planes' down and up sampling.
        PlaneCompression = "plane-compression",
        /// The wavelet constraint.
        Wavelet = "wavelet",
        /// The offset masks.
        Masks = "masks",
    }
}

/// How large a cell of the anchors' lattice is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Voxel {
    /// A fraction of the points' spacing: right whatever the unit of the scene.
    #[default]
    Auto,
    /// As the published code chooses it: a squared distance taken for a length (method.md §1.2).
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
    type Err = OptionError;

    fn from_str(text: &str) -> Result<Self, OptionError> {
        match text {
            "auto" => Ok(Voxel::Auto),
            "published" => Ok(Voxel::Published),
            _ => text.parse().map(Voxel::Edge).map_err(|_| {
                OptionError::new(
                    "voxel",
                    format!("'{text}' is not auto, published or a length in world units"),
                )
            }),
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
    /// Weight of the rate term; the preset's own if absent.
    pub lambda: Option<f64>,
    /// Promise on the size of the written file.
    pub max_bytes: Option<u64>,
}

impl Default for TrainOptions {
    fn default() -> Self {
        Self {
            preset: Preset::Preview,
            iterations: None,
            seed: 0,
            background: Background::Black,
            model: ModelKind::Tcgs,
            voxel: Voxel::Auto,
            without: BTreeSet::new(),
            lambda: None,
            max_bytes: None,
        }
    }
}

impl TrainOptions {
    /// Sets one option from its query-string or flag text; `without` takes a comma-separated list.
    ///
    /// # Errors
    /// [`OptionError`] for an unknown name or an impossible value.
    pub fn set(&mut self, option: &str, text: &str) -> Result<(), OptionError> {
        match option {
            "preset" => self.preset = text.parse()?,
            "iterations" => self.iterations = Some(number("iterations", text)?),
            "seed" => self.seed = number("seed", text)?,
            "background" => self.background = text.parse()?,
            "model" => self.model = text.parse()?,
            "voxel" => self.voxel = text.parse()?,
            "without" => {
                for name in text.split(',').filter(|name| !name.is_empty()) {
                    self.without.insert(name.parse()?);
                }
            }
            "lambda" => self.lambda = Some(number("lambda", text)?),
            "max_bytes" => self.max_bytes = Some(number("max_bytes", text)?),
            _ => return Err(OptionError::new("query", format!("'{option}' is not an option"))),
        }
        Ok(())
    }

    /// Whether a part of the method takes part: the baselines have none of them.
    #[must_use]
    pub fn has(&self, part: Component) -> bool {
        self.model == ModelKind::Tcgs && !self.without.contains(&part)
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
        if let Voxel::Edge(edge) = self.voxel
            && !(edge.is_finite() && edge > 0.0 && (edge as f32).is_normal())
        {
            return Err(OptionError::new("voxel", format!("{edge} is not a positive length")));
        }
        if let Some(lambda) = self.lambda {
            if !(lambda.is_finite() && lambda > 0.0 && (lambda as f32).is_normal()) {
                return Err(OptionError::new("lambda", format!("{lambda} is not a positive weight")));
            }
            if self.model != ModelKind::Tcgs {
                let fault = format!("model '{}' has no rate term to weigh", self.model);
                return Err(OptionError::new("lambda", fault));
            }
        }
        if self.max_bytes.is_some() {
            return Err(OptionError::new("max_bytes", "this version has no rate control"));
        }
        Ok(self)
    }
}

fn number<T: FromStr>(option: &'static str, text: &str) -> Result<T, OptionError> {
    text.parse().map_err(|_| OptionError::new(option, format!("'{text}' is not a number in range")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_set_by_name_and_faults_name_the_option() {
        let mut options = TrainOptions::default();
        options.set("preset", "standard").expect("a preset");
        options.set("iterations", "1500").expect("a number");
        options.set("background", "white").expect("a background");
        assert_eq!(options.preset, Preset::Standard);
        assert_eq!(options.iterations, Some(1500));
        let fault = options.set("preset", "fast").expect_err("no such preset");
        assert_eq!(fault.to_string(), "preset: 'fast' is not one of preview, standard, paper");
        assert!(options.set("seed", "-1").is_err());
        assert!(options.set("colour", "red").is_err());
    }

    #[test]
    fn a_part_is_on_in_the_method_and_off_in_the_baselines_and_where_it_is_left_out() {
        let mut options = TrainOptions::default();
        assert!(options.has(Component::Wavelet));
        options.set("without", "wavelet").expect("a part");
        let options = options.validated().expect("this version has it");
        assert!(!options.has(Component::Wavelet) && options.has(Component::Masks));
        for model in [ModelKind::Scaffold, ModelKind::Gaussians3d] {
            let baseline = TrainOptions { model, ..TrainOptions::default() };
            assert!(!baseline.has(Component::Wavelet));
        }
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
            assert_eq!(text.parse::<Voxel>().expect_err(text).option, "voxel");
        }
        for edge in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-300, 1e300] {
            let options = TrainOptions { voxel: Voxel::Edge(edge), ..TrainOptions::default() };
            assert_eq!(options.validated().expect_err("no length").option, "voxel", "{edge}");
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
        options.set("max_bytes", "1000").expect("parses");
        assert_eq!(options.validated().expect_err("no rate control").option, "max_bytes");
        let mut options = TrainOptions::default();
        let parts: Vec<&str> = Component::ALL.iter().map(|part| part.name()).collect();
        options.set("without", &parts.join(",")).expect("parses");
        let options = options.validated().expect("every part can be left out");
        assert!(Component::ALL.iter().all(|part| !options.has(*part)));
        let zero = TrainOptions { iterations: Some(0), ..TrainOptions::default() };
        assert!(zero.validated().is_err());
    }
}
