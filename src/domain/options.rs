//! Training options: the same names and meanings on the command line, in the query string and in JSON.

use std::{collections::BTreeSet, fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Largest number of steps that a job may ask for.
pub const MAX_ITERATIONS: u32 = 1_000_000;

/// Most points of a rate-distortion curve.
pub const MAX_CURVE_POINTS: usize = 8;

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
    pub(crate) fn new(option: &'static str, fault: impl Into<String>) -> Self {
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
        /// The planes' down and up sampling, a part of runs of 30 000 steps and more only, if not asked for.
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
    /// Parts that are on in runs that would do without them. Told only where there are some.
    #[serde(skip_serializing_if = "BTreeSet::is_empty")]
    pub with: BTreeSet<Component>,
    /// Weight of the rate term; the preset's own if absent.
    pub lambda: Option<f64>,
    /// Promise on the size of the written file, every byte of it.
    pub max_bytes: Option<u64>,
    /// Weights of the rate term, each of which a branch of the run is made for and a file written; empty for one run and one
    /// file.
    pub rd_curve: Vec<f64>,
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
            with: BTreeSet::new(),
            lambda: None,
            max_bytes: None,
            rd_curve: Vec::new(),
        }
    }
}

impl TrainOptions {
    /// The name of every option.
    pub const NAMES: [&str; 11] = [
        "preset",
        "iterations",
        "seed",
        "background",
        "model",
        "voxel",
        "without",
        "with",
        "lambda",
        "max_bytes",
        "rd_curve",
    ];

    /// Sets one option from its query-string or flag text; `without`, `with` and `rd_curve` take comma-separated lists, the last
    /// with or without the brackets that JSON has.
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
            "with" => {
                for name in text.split(',').filter(|name| !name.is_empty()) {
                    let named: Result<Component, OptionError> = name.parse();
                    self.with.insert(named.map_err(|fault| OptionError::new("with", fault.fault))?);
                }
            }
            "lambda" => self.lambda = Some(number("lambda", text)?),
            "max_bytes" => self.max_bytes = Some(number("max_bytes", text)?),
            "rd_curve" => {
                let list = text.strip_prefix('[').and_then(|list| list.strip_suffix(']')).unwrap_or(text);
                self.rd_curve =
                    list.split(',').map(|text| number("rd_curve", text.trim())).collect::<Result<_, _>>()?;
            }
            _ => {
                let known = Self::NAMES.join(", ");
                return Err(OptionError::new(
                    "query",
                    format!("'{option}' is not an option; there are {known}"),
                ));
            }
        }
        Ok(())
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
        self.check_with()?;
        self.check_max_bytes()?;
        self.check_rd_curve()?;
        Ok(self)
    }

    fn check_with(&self) -> Result<(), OptionError> {
        let fault = |text: String| Err(OptionError::new("with", text));
        for part in &self.with {
            if *part != Component::PlaneCompression {
                return fault(format!("'{part}' is in every run that does not leave it out"));
            }
            if !self.has(*part) || !self.has(Component::TriPlane) {
                return fault(format!(
                    "'{part}' has no part in a run of model '{}' without its planes",
                    self.model
                ));
            }
        }
        Ok(())
    }

    fn check_max_bytes(&self) -> Result<(), OptionError> {
        let fault = |text: String| Err(OptionError::new("max_bytes", text));
        match self.max_bytes {
            None => Ok(()),
            Some(0) => fault("0 bytes hold no file".to_owned()),
            Some(_) if self.model != ModelKind::Tcgs => {
                fault(format!("the model {} is written as floats, whose size cannot be chosen", self.model))
            }
            Some(_) if !self.rd_curve.is_empty() => {
                fault("a curve has files of several sizes; leave out max_bytes or rd_curve".to_owned())
            }
            Some(_) => Ok(()),
        }
    }

    fn check_rd_curve(&self) -> Result<(), OptionError> {
        let fault = |text: String| Err(OptionError::new("rd_curve", text));
        let curve = &self.rd_curve;
        if curve.is_empty() {
            return Ok(());
        }
        if self.model != ModelKind::Tcgs {
            return fault(format!("the model {} has no rate to weigh", self.model));
        }
        if self.lambda.is_some() {
            return fault("each of its points has its own lambda; leave out lambda or rd_curve".to_owned());
        }
        if curve.len() > MAX_CURVE_POINTS {
            return fault(format!("{} points are more than {MAX_CURVE_POINTS}", curve.len()));
        }
        for (index, lambda) in curve.iter().enumerate() {
            if !(lambda.is_finite() && *lambda > 0.0) {
                return fault(format!("{lambda} is not a positive weight"));
            }
            if curve[..index].contains(lambda) {
                return fault(format!("{lambda} is given twice"));
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
    fn every_option_has_its_name_in_the_list() {
        let all = TrainOptions { with: Component::ALL.iter().copied().collect(), ..TrainOptions::default() };
        let fields = serde_json::to_value(all).expect("JSON");
        let fields: Vec<&String> = fields.as_object().expect("an object").keys().collect();
        assert_eq!(fields, TrainOptions::NAMES.each_ref());
        for name in TrainOptions::NAMES {
            let unknown = |fault: OptionError| fault.to_string().contains("is not an option");
            assert!(!TrainOptions::default().set(name, "?").is_err_and(unknown), "{name}");
        }
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
    fn only_what_runs_do_without_by_themselves_can_be_asked_for() {
        let asked = |model, without: &[Component], with: &str| {
            let without = without.iter().copied().collect();
            let mut options = TrainOptions { model, without, ..TrainOptions::default() };
            options.set("with", with)?;
            options.validated()
        };
        let options = asked(ModelKind::Tcgs, &[], "plane-compression").expect("possible");
        assert_eq!(
            serde_json::to_value(&options).expect("JSON")["with"],
            serde_json::json!(["plane-compression"])
        );
        let usual = serde_json::to_value(TrainOptions::default()).expect("JSON");
        assert!(usual.get("with").is_none(), "files say nothing of what was not asked for");
        for fault in [
            asked(ModelKind::Tcgs, &[], "masks"),
            asked(ModelKind::Tcgs, &[], "hope"),
            asked(ModelKind::Tcgs, &[Component::PlaneCompression], "plane-compression"),
            asked(ModelKind::Tcgs, &[Component::TriPlane], "plane-compression"),
            asked(ModelKind::Scaffold, &[], "plane-compression"),
        ] {
            assert_eq!(fault.expect_err("refused").option, "with");
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
    fn a_promise_on_the_size_is_for_the_method_alone() {
        let set = |pairs: &[(&str, &str)]| {
            let mut options = TrainOptions::default();
            pairs.iter().for_each(|(name, value)| options.set(name, value).expect("parses"));
            options.validated()
        };
        assert_eq!(set(&[("max_bytes", "50000")]).expect("possible").max_bytes, Some(50_000));
        for wrong in [
            &[("max_bytes", "0")][..],
            &[("max_bytes", "50000"), ("model", "scaffold")],
            &[("max_bytes", "50000"), ("model", "3dgs")],
            &[("max_bytes", "50000"), ("rd_curve", "0.001")],
        ] {
            assert_eq!(set(wrong).expect_err("impossible").option, "max_bytes", "{wrong:?}");
        }
        for text in ["-1", "1e6", "5 MB", ""] {
            let fault = TrainOptions::default().set("max_bytes", text).expect_err(text);
            assert_eq!(fault.option, "max_bytes");
        }
    }

    #[test]
    fn a_curve_is_a_list_of_distinct_weights_in_the_order_given() {
        let curve = |text: &str| {
            let mut options = TrainOptions::default();
            options.set("rd_curve", text).and_then(|()| options.validated())
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
        for wrong in ["", "0.001,", "[0.001", "0", "-1", "nan", "inf", "0.001,1e-3", "many", &nine.join(",")]
        {
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
        options.set("without", &parts.join(",")).expect("parses");
        let options = options.validated().expect("every part can be left out");
        assert!(Component::ALL.iter().all(|part| !options.has(*part)));
        let zero = TrainOptions { iterations: Some(0), ..TrainOptions::default() };
        assert!(zero.validated().is_err());
    }
}
