//! The matrix of a report: a TOML file that declares which runs are made and what is measured beside them.
//!
//! Every value is checked as it is read, so that a fault is told with its line before anything is trained.

use std::{collections::BTreeMap, fmt, str::FromStr};

use serde::{Deserialize, Deserializer, de::Error as _};
use serde_json::Value;
use tcgs_codec::domain::{Background, HoldOut, MaxWidth, ModelKind, Preset, SceneFormat, TrainOptions};

use super::variant::Variant;

/// Runs that a matrix may declare; more are a mistake in a list.
const MAX_RUNS: usize = 10_000;

/// The file as written.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Matrix {
    /// A script that converts the `.ply` of 3dgs to other programs' formats and back, relative to this file.
    #[serde(default)]
    pub external_formats: Option<String>,
    /// Formats that finished scenes are exported to and measured in.
    #[serde(default)]
    pub export_formats: Vec<Checked<ExportFormat>>,
    /// Held-out views on which the f32 renderer is held to the f64 reference; none are if 0.
    #[serde(default = "one")]
    pub reference_views: usize,
    /// Longest side in pixels at which it is.
    #[serde(default = "reference_side")]
    pub reference_side: u32,
    /// Scenes of published figures by set, as `DATASET/SCENE`.
    #[serde(default)]
    pub published: BTreeMap<String, String>,
    /// Speed against error of the renderer on made scenes.
    #[serde(default)]
    pub render: Option<RenderSweep>,
    /// Blocks of runs.
    #[serde(default)]
    pub runs: Vec<Block>,
}

fn one() -> usize {
    1
}

fn reference_side() -> u32 {
    256
}

/// A product of lists: every combination is a run.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Block {
    /// Names of sets; all of the folder if empty.
    #[serde(default)]
    pub sets: Vec<toml::Spanned<String>>,
    models: Vec<Checked<Model>>,
    #[serde(default)]
    presets: Vec<Checked<PresetName>>,
    #[serde(default)]
    steps: Vec<Checked<Steps>>,
    /// For tcgs alone; the preset's weight if empty.
    #[serde(default)]
    lambda: Vec<Checked<Lambda>>,
    #[serde(default = "first_seed")]
    seeds: Vec<u64>,
    #[serde(default)]
    adapters: Vec<String>,
    #[serde(default)]
    background: Option<Background>,
    /// A sector is held out instead of what the layout says.
    #[serde(default)]
    sector: bool,
    /// Widths to which photographs are downscaled; the usual limit if empty.
    #[serde(default)]
    max_width: Vec<Checked<Width>>,
}

fn first_seed() -> Vec<u64> {
    vec![0]
}

/// Sizes of made scenes and pictures.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RenderSweep {
    /// Sides of the square pictures in pixels.
    pub sides: Vec<Checked<Side>>,
    /// Numbers of Gaussians.
    pub gaussians: Vec<Checked<Count>>,
    /// Timed renders of each kind.
    #[serde(default = "repeats")]
    pub repeats: usize,
}

fn repeats() -> usize {
    5
}

/// A value with bounds or names of its own, so that the parser tells the line of a wrong one.
#[derive(Debug, Clone, PartialEq)]
pub struct Checked<T: Check>(pub T::Read);

/// How a value is read from the file.
pub trait Check {
    type Read: fmt::Debug + Clone + PartialEq;
    fn read(value: &Value) -> Result<Self::Read, String>;
}

impl<'de, T: Check> Deserialize<'de> for Checked<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        T::read(&Value::deserialize(deserializer)?).map(Self).map_err(D::Error::custom)
    }
}

fn named<T: FromStr<Err = String>>(value: &Value, what: &str) -> Result<T, String> {
    value.as_str().ok_or_else(|| format!("{value} is not the name of {what}"))?.parse()
}

fn integer<T: TryFrom<i64>>(value: &Value, what: &str, low: i64, high: i64) -> Result<T, String> {
    let number = value.as_i64().filter(|number| (low..=high).contains(number));
    number
        .and_then(|number| T::try_from(number).ok())
        .ok_or_else(|| format!("{value} is not a number of {what} from {low} to {high}"))
}

macro_rules! checks {
    ($($name:ident: $value:ty = $read:expr;)+) => {$(
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name;
        impl Check for $name {
            type Read = $value;
            fn read(value: &Value) -> Result<$value, String> {
                let read: fn(&Value) -> Result<$value, String> = $read;
                read(value)
            }
        }
    )+};
}

checks! {
    Model: Variant = |value| named(value, "a model");
    PresetName: Preset = |value| named(value, "a preset");
    ExportFormat: SceneFormat = |value| match named(value, "a format")? {
        format if SceneFormat::EXPORTS.contains(&format) => Ok(format),
        _ => Err(format!("{value} is not a format of plain Gaussians: ply, spz, spz3, glb, usda or sog")),
    };
    Steps: u32 = |value| integer(value, "steps", 1, i64::from(tcgs_codec::domain::options::MAX_ITERATIONS));
    Side: u32 = |value| integer(value, "pixels", 8, 4096);
    Width: MaxWidth = |value| {
        integer(value, "pixels", i64::from(MaxWidth::MIN), i64::from(MaxWidth::MAX)).and_then(MaxWidth::new)
    };
    Count: usize = |value| integer(value, "Gaussians", 1, 10_000_000);
    Lambda: f64 = |value| {
        let number = value.as_f64();
        let options = TrainOptions { lambda: number, ..TrainOptions::default() };
        match number {
            Some(number) if options.validated().is_ok() => Ok(number),
            _ => Err(format!("{value} is not a positive weight")),
        }
    };
}

/// A run that the matrix wants.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedRun {
    /// Name of the set.
    pub set: String,
    /// The model with its switched parts, without a weight.
    pub model: String,
    pub options: TrainOptions,
    /// The adapter as asked for; `None` for the command's own.
    pub adapter: Option<String>,
}

impl PlannedRun {
    /// The set as tables name it: with another split, or at another size, it is another set.
    #[must_use]
    pub fn set_name(&self) -> String {
        let mut name = self.set.clone();
        if self.options.holdout == HoldOut::Sector {
            name.push_str("-sector");
        }
        if self.options.max_width != MaxWidth::DEFAULT {
            name.push_str(&format!("-{}px", self.options.max_width));
        }
        name
    }
}

impl fmt::Display for PlannedRun {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.set_name(), self.model)?;
        if let Some(lambda) = self.options.lambda {
            write!(f, "@{lambda}")?;
        }
        write!(f, " seed {}", self.options.seed)
    }
}

impl Matrix {
    /// The matrix that a text in TOML declares.
    ///
    /// # Errors
    /// What is wrong with it, and where.
    pub fn parse(text: &str) -> Result<Self, String> {
        let matrix: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        if matrix.runs.is_empty() && matrix.render.is_none() {
            return Err("there is no [[runs]] and no [render], so there is nothing to do".to_owned());
        }
        for (number, block) in matrix.runs.iter().enumerate() {
            let empty = [("models", block.models.is_empty()), ("seeds", block.seeds.is_empty())];
            if let Some((field, _)) = empty.iter().find(|(_, is_empty)| *is_empty) {
                return Err(format!("[[runs]] number {}: {field} is empty", number + 1));
            }
            for model in &block.models {
                for options in block.options(model.0) {
                    options.validated().map_err(|error| {
                        format!("[[runs]] number {}: {}: {}", number + 1, error.option, error.error)
                    })?;
                }
            }
        }
        Ok(matrix)
    }

    /// The sets that blocks name.
    pub fn named_sets(&self) -> Vec<&str> {
        let mut names: Vec<&str> =
            self.runs.iter().flat_map(|block| block.sets.iter().map(|set| set.get_ref().as_str())).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// Whether some block takes every set of the folder.
    pub fn takes_all_sets(&self) -> bool {
        self.runs.iter().any(|block| block.sets.is_empty())
    }

    /// Every run once, in the order in which they are made: seeds change slowest and models fastest, so that runs that will be compared
    /// follow one another and meet the machine in the same state.
    ///
    /// # Errors
    /// If they are too many.
    pub fn plan(&self, sets: &[String]) -> Result<Vec<PlannedRun>, String> {
        let mut plan: Vec<(usize, PlannedRun)> = Vec::new();
        for block in &self.runs {
            for (rank, run) in block.plan(sets) {
                if !plan.iter().any(|(_, other)| *other == run) {
                    plan.push((rank, run));
                }
            }
            if plan.len() > MAX_RUNS {
                return Err(format!("the matrix declares more than {MAX_RUNS} runs"));
            }
        }
        // Stable: within a seed, the order of the blocks.
        plan.sort_by_key(|(rank, _)| *rank);
        Ok(plan.into_iter().map(|(_, run)| run).collect())
    }
}

impl Block {
    /// The runs in order, each with the place of its seed in the list.
    fn plan(&self, all: &[String]) -> Vec<(usize, PlannedRun)> {
        let own: Vec<&String> = self.sets.iter().map(toml::Spanned::get_ref).collect();
        let sets: Vec<&String> = if own.is_empty() { all.iter().collect() } else { own };
        let adapters: Vec<Option<&String>> =
            if self.adapters.is_empty() { vec![None] } else { self.adapters.iter().map(Some).collect() };
        let mut plan = Vec::new();
        for (rank, seed) in self.seeds.iter().enumerate() {
            for set in &sets {
                for schedule in self.schedules() {
                    for adapter in &adapters {
                        for model in &self.models {
                            for options in self.weighted(model.0, &schedule) {
                                let run = PlannedRun {
                                    set: (*set).clone(),
                                    model: model.0.to_string(),
                                    options: TrainOptions { seed: *seed, ..options },
                                    adapter: adapter.cloned(),
                                };
                                plan.push((rank, run));
                            }
                        }
                    }
                }
            }
        }
        plan
    }

    fn schedules(&self) -> Vec<TrainOptions> {
        let presets: Vec<Preset> = self.presets.iter().map(|preset| preset.0).collect();
        let presets = if presets.is_empty() { vec![TrainOptions::default().preset] } else { presets };
        let steps: Vec<Option<u32>> = self.steps.iter().map(|steps| Some(steps.0)).collect();
        let steps = if steps.is_empty() { vec![None] } else { steps };
        let widths: Vec<MaxWidth> = self.max_width.iter().map(|width| width.0).collect();
        let widths = if widths.is_empty() { vec![MaxWidth::DEFAULT] } else { widths };
        let background = self.background.unwrap_or(TrainOptions::default().background);
        let mut schedules = Vec::new();
        for preset in presets {
            for iterations in &steps {
                for max_width in &widths {
                    schedules.push(TrainOptions {
                        preset,
                        iterations: *iterations,
                        background,
                        holdout: if self.sector { HoldOut::Sector } else { HoldOut::Auto },
                        max_width: *max_width,
                        ..TrainOptions::default()
                    });
                }
            }
        }
        schedules
    }

    /// The options of a model with every weight, if it has one.
    fn weighted(&self, model: Variant, schedule: &TrainOptions) -> Vec<TrainOptions> {
        let options = model.options(schedule);
        if model.model != ModelKind::Tcgs || self.lambda.is_empty() {
            return vec![options];
        }
        let weighted = |lambda: &Checked<Lambda>| TrainOptions { lambda: Some(lambda.0), ..options.clone() };
        self.lambda.iter().map(weighted).collect()
    }

    fn options(&self, model: Variant) -> Vec<TrainOptions> {
        self.schedules().iter().flat_map(|schedule| self.weighted(model, schedule)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: &str = r#"
        [[runs]]
        models = ["3dgs", "tcgs-wavelet"]
        steps = [10]
        lambda = [0.001, 0.004]
        seeds = [3, 5]
    "#;

    #[test]
    fn a_block_may_hold_out_a_sector_and_names_its_set_so() {
        let text = "[[runs]]\nmodels = [\"3dgs\"]\nsector = true\n[[runs]]\nmodels = [\"3dgs:100\", \"3dgs:100-capped\"]";
        let plan = Matrix::parse(text).expect("a matrix").plan(&["a".to_owned()]).expect("a plan");
        let names: Vec<String> = plan.iter().map(ToString::to_string).collect();
        assert_eq!(names, ["a-sector 3dgs seed 0", "a 3dgs:100 seed 0", "a 3dgs:100-capped seed 0"]);
        assert_eq!(plan.iter().map(|run| run.options.holdout).next(), Some(HoldOut::Sector));
        assert_eq!((plan[1].options.target_gaussians, plan[2].options.max_gaussians), (Some(100), Some(100)));
    }

    #[test]
    fn a_block_may_have_widths_and_names_its_sets_by_them() {
        let text = "[[runs]]\nmodels = [\"3dgs\", \"tcgs\"]\nmax_width = [100, 1600]\nsector = true";
        let plan = Matrix::parse(text).expect("a matrix").plan(&["a".to_owned()]).expect("a plan");
        let names: Vec<String> = plan.iter().map(ToString::to_string).collect();
        let expected = ["a-sector-100px 3dgs", "a-sector-100px tcgs", "a-sector 3dgs", "a-sector tcgs"];
        assert_eq!(names, expected.map(|name| format!("{name} seed 0")));
        assert_eq!(plan[0].options.max_width.pixels(), 100);
    }

    #[test]
    fn every_combination_is_a_run_and_models_change_fastest() {
        let matrix = Matrix::parse(SMALL).expect("a matrix");
        let plan = matrix.plan(&["a".to_owned(), "b".to_owned()]).expect("a plan");
        let names: Vec<String> = plan.iter().map(ToString::to_string).collect();
        assert_eq!(
            names,
            [
                "a 3dgs seed 3",
                "a tcgs-wavelet@0.001 seed 3",
                "a tcgs-wavelet@0.004 seed 3",
                "b 3dgs seed 3",
                "b tcgs-wavelet@0.001 seed 3",
                "b tcgs-wavelet@0.004 seed 3",
                "a 3dgs seed 5",
                "a tcgs-wavelet@0.001 seed 5",
                "a tcgs-wavelet@0.004 seed 5",
                "b 3dgs seed 5",
                "b tcgs-wavelet@0.001 seed 5",
                "b tcgs-wavelet@0.004 seed 5",
            ]
        );
        assert!(plan.iter().all(|run| run.options.iterations == Some(10)));
    }

    #[test]
    fn blocks_that_overlap_make_a_run_once() {
        let matrix = Matrix::parse(&format!("{SMALL}\n{SMALL}")).expect("a matrix");
        assert_eq!(matrix.plan(&["a".to_owned()]).expect("a plan").len(), 6);
    }

    #[test]
    fn the_examples_in_the_repository_are_matrices() {
        let full = include_str!("../../../../benches/report.toml");
        let small = include_str!("../../../../benches/report-small.toml");
        let ladder = include_str!("../../../../benches/ladder.toml");
        let opponents = include_str!("../../../../benches/opponents.toml");
        for (name, text) in
            [("report", full), ("report-small", small), ("ladder", ladder), ("opponents", opponents)]
        {
            let matrix = Matrix::parse(text).expect(name);
            assert!(!matrix.plan(&["a".to_owned()]).expect("a plan").is_empty(), "{name}");
        }
    }

    #[test]
    fn faults_name_the_line_and_the_field() {
        for (text, words) in [
            ("[[runs]]\nmodels = [\"nerf\"]\n", &["line 2", "'nerf'"][..]),
            ("[[runs]]\nmodels = [\"tcgs\"]\nsteps = [0]\n", &["line 3", "0 is not a number of steps"]),
            ("[[runs]]\nmodels = [\"tcgs\"]\nlambda = [-1.0]\n", &["line 3", "not a positive weight"]),
            ("[[runs]]\nmodels = [\"tcgs@0.1\"]\n", &["line 2", "lambda"]),
            ("[[runs]]\nmodels = [\"tcgs\"]\nuntil = [\"full\"]\n", &["line 3", "until"]),
            ("[[runs]]\nmodel = [\"tcgs\"]\n", &["line 2", "model"]),
            ("[[runs]]\nmodels = [\"tcgs\"]\npresets = [\"fast\"]\n", &["line 3", "fast"]),
            ("[[runs]]\nmodels = []\n", &["number 1", "models is empty"]),
            ("export_formats = [\"tcgs\"]\n", &["line 1", "plain Gaussians"]),
            ("[[runs]]\nmodels = [\"tcgs\"]\nmax_width = [8]\n", &["line 3", "from 16 to 8192"]),
            ("[render]\nsides = [4]\ngaussians = [10]\n", &["line 2", "pixels"]),
            ("", &["nothing to do"]),
        ] {
            let error = Matrix::parse(text).expect_err(text);
            assert!(words.iter().all(|word| error.contains(word)), "{text}: {error}");
        }
    }
}
