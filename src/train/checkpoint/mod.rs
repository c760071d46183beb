//! The state of a run between two steps, and its form as a file.
//!
//! What always holds: a run that goes on from a checkpoint ends with the same bits as one that was never interrupted,
//! whichever step the checkpoint is of; and a file that is torn, changed, or of another run is refused with what differs.
//!
//! The file is safetensors: one tensor for each array of the learner, and in the metadata `tcgs.checkpoint` (version of this
//! layout), `run` (JSON: program, options, dataset, step, random generator, order of the photographs still to come) and
//! `crc32c` (of `run`, then of the names and bytes of the tensors in the order of their names).

mod folder;
mod model_state;

use std::{
    collections::{BTreeMap, HashMap},
    io,
    path::{Path, PathBuf},
};

use rand_pcg::Pcg64;
use safetensors::{Dtype, SafeTensorError, SafeTensors};
use serde::{Deserialize, Serialize};
use serde_json::json;
use thiserror::Error;

pub use folder::{CheckpointFolder, KeepCheckpoints};
use model_state::Array;
pub(super) use model_state::LearnerState;

use super::{LossSums, RateControl, RateState, Schedule};
use crate::domain::{Digest, Problem, TrainOptions};

/// Version of the layout of the file.
const VERSION: &str = "1";

/// The program, whose schedule and arithmetic a run depends on.
const GENERATOR: &str = concat!("tcgs ", env!("CARGO_PKG_VERSION"));

/// Keys of the metadata.
const VERSION_KEY: &str = "tcgs.checkpoint";
const RUN_KEY: &str = "run";
const CHECKSUM_KEY: &str = "crc32c";

/// Why a checkpoint cannot be kept or gone on from.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// There is none.
    #[error("{} does not exist; there is no checkpoint to go on from", .0.display())]
    Missing(PathBuf),
    /// The file system refused.
    #[error("{}: {fault}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        fault: io::Error,
    },
    /// The file is cut off, or no checkpoint at all.
    #[error("not a whole checkpoint: {0}")]
    Format(String),
    /// The bytes are not those that were written.
    #[error("the checkpoint is damaged: its checksum is {found:08x} where {stated} is stated")]
    Damaged {
        /// Of the content.
        found: u32,
        /// In the file.
        stated: String,
    },
    /// The file's layout is of another version.
    #[error("the checkpoint's layout has version {0}; this program reads version {VERSION}")]
    Version(String),
    /// Another version of the program wrote it.
    #[error("the checkpoint is of {0}, this is {GENERATOR}; a run must end with the version that began it")]
    Generator(String),
    /// It is of a run with other options.
    #[error("the checkpoint is of a run with other options: {0}")]
    Options(String),
    /// It is of a run on another dataset.
    #[error("the checkpoint is of a run on dataset {found}, this is dataset {expected}")]
    Dataset {
        /// The checkpoint's.
        found: Digest,
        /// The run's.
        expected: Digest,
    },
    /// An array does not fit the model.
    #[error("the checkpoint's array '{name}' {fault}")]
    Array {
        /// Its name.
        name: String,
        /// What is wrong.
        fault: String,
    },
    /// A figure of the run cannot be.
    #[error("the checkpoint's {0}")]
    Run(String),
}

impl CheckpointError {
    /// A fault of the array `name`.
    pub(super) fn array(name: &str, fault: impl Into<String>) -> Self {
        Self::Array { name: name.to_owned(), fault: fault.into() }
    }

    /// A fault of the file system at `path`.
    pub(super) fn io(path: &Path, fault: io::Error) -> Self {
        Self::Io { path: path.to_owned(), fault }
    }
}

impl From<CheckpointError> for Problem {
    fn from(fault: CheckpointError) -> Self {
        Problem::new(422, "checkpoint-refused", "The checkpoint cannot be used", fault.to_string())
    }
}

/// What a run without its learner is between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RunState {
    /// Name and version of the program.
    generator: String,
    /// The options as JSON. As text, since numbers do not always survive being parsed.
    options: String,
    /// Digest of the dataset.
    dataset: Digest,
    /// Adapter and driver; on another one the run goes on, but its bits may differ.
    adapter: String,
    /// Size of the model that growth may reach, which the adapter and the memory allowed bound.
    pub(super) most: usize,
    /// Steps done.
    pub(super) step: u32,
    /// Seconds of training so far.
    pub(super) seconds: f64,
    /// Random numbers still to come.
    pub(super) rng: Pcg64,
    /// Photographs still to come in this round, the next one last.
    pub(super) order: Vec<usize>,
    /// The bits of the averages that progress tells: SSIM, L1, squared error, wavelet bands.
    average: Option<[u64; 4]>,
    /// The bits of the rate's weight in the loss.
    lambda: u64,
    /// What the controller of that weight remembers.
    control: Option<RateState>,
    /// The bits of what an anchor's attributes cost, in bits, averaged over recent samples.
    anchor_bits: Option<u64>,
    /// Bytes that the file would about have.
    file_bytes: Option<u64>,
}

/// What a run is made from: a checkpoint belongs to one of these.
#[derive(Debug, Clone, Copy)]
pub(super) struct Origin<'a> {
    pub(super) options: &'a TrainOptions,
    pub(super) dataset: Digest,
    pub(super) adapter: &'a str,
    /// Size of the model that growth may reach.
    pub(super) most: usize,
}

impl RunState {
    /// The state of a run at its begin.
    pub(super) fn begin(origin: Origin<'_>, rng: Pcg64, lambda: f64) -> Self {
        Self {
            generator: GENERATOR.to_owned(),
            options: options_text(origin.options),
            dataset: origin.dataset,
            adapter: origin.adapter.to_owned(),
            most: origin.most,
            step: 0,
            seconds: 0.0,
            rng,
            order: Vec::new(),
            average: None,
            lambda: lambda.to_bits(),
            control: None,
            anchor_bits: None,
            file_bytes: None,
        }
    }

    /// Takes the run to an adapter and a bound of growth that may not be those that it began with. A larger bound is left
    /// unused, since the bits depend on it.
    pub(super) fn move_to(&mut self, adapter: &str, most: usize) {
        if self.adapter != adapter {
            tracing::warn!("the run began on {} and goes on on {adapter}; its bits may differ", self.adapter);
            adapter.clone_into(&mut self.adapter);
        }
        if most < self.most {
            tracing::warn!("growth could reach {} and now only {most}; the bits may differ", self.most);
            self.most = most;
        }
    }

    /// The averages that progress tells.
    pub(super) fn average(&self) -> Option<LossSums> {
        let [ssim, l1, mse, wavelet] = self.average?.map(f64::from_bits);
        Some(LossSums { ssim, l1, mse, wavelet })
    }

    /// Remembers them.
    pub(super) fn set_average(&mut self, sums: LossSums) {
        self.average = Some([sums.ssim, sums.l1, sums.mse, sums.wavelet].map(f64::to_bits));
    }

    /// Weight of the rate in the loss.
    pub(super) fn lambda(&self) -> f64 {
        f64::from_bits(self.lambda)
    }

    /// Weighs the rate as `control` has it from the next step on, and remembers what it remembers.
    pub(super) fn steer(&mut self, control: &RateControl) {
        self.lambda = control.lambda().to_bits();
        self.control = Some(control.state());
    }

    /// The controller as it was when the state was taken.
    pub(super) fn resume_control(&self, control: RateControl) -> RateControl {
        match self.control {
            Some(state) => control.at(state),
            None => control,
        }
    }

    /// Bytes that the file would about have, once samples were weighed.
    pub(super) fn file_bytes(&self) -> Option<u64> {
        self.file_bytes
    }

    /// Takes notice of what an anchor of a sample cost, on average, where there are `anchors` anchors and the rest of the
    /// file takes `other_bytes`.
    pub(super) fn weigh(&mut self, anchor_bits: f64, anchors: f64, other_bytes: f64) {
        // One sample is a few hundred anchors and good to some hundredths; short runs change faster than a longer average would.
        let mean = self.anchor_bits.map_or(anchor_bits, |old| 0.3 * f64::from_bits(old) + 0.7 * anchor_bits);
        self.anchor_bits = Some(mean.to_bits());
        self.file_bytes = Some((anchors * mean / 8.0 + other_bytes) as u64);
    }

    /// Checks that a run of `steps` steps over `frames` photographs from `origin` may go on from here.
    fn check(&self, origin: Origin<'_>, steps: u32, frames: usize) -> Result<(), CheckpointError> {
        if self.generator != GENERATOR {
            return Err(CheckpointError::Generator(self.generator.clone()));
        }
        let expected = options_text(origin.options);
        if self.options != expected {
            return Err(CheckpointError::Options(differences(&self.options, &expected)));
        }
        if self.dataset != origin.dataset {
            return Err(CheckpointError::Dataset { found: self.dataset, expected: origin.dataset });
        }
        if !(1..=steps).contains(&self.step) {
            return Err(CheckpointError::Run(format!("step {} is not one of 1 to {steps}", self.step)));
        }
        if let Some(frame) = self.order.iter().find(|frame| **frame >= frames) {
            return Err(CheckpointError::Run(format!("order names photograph {frame} of {frames}")));
        }
        if !(self.seconds.is_finite() && self.seconds >= 0.0) {
            return Err(CheckpointError::Run(format!("time of {} s is impossible", self.seconds)));
        }
        Ok(())
    }
}

fn options_text(options: &TrainOptions) -> String {
    serde_json::to_string(options).expect("options have names for keys and nothing that JSON lacks")
}

/// The options that differ, with both values.
fn differences(found: &str, expected: &str) -> String {
    let parse = |text| serde_json::from_str::<BTreeMap<String, serde_json::Value>>(text).unwrap_or_default();
    let (found, expected) = (parse(found), parse(expected));
    let names: Vec<String> = found
        .keys()
        .chain(expected.keys().filter(|name| !found.contains_key(*name)))
        .filter(|name| found.get(*name) != expected.get(*name))
        .map(|name| {
            let show =
                |side: Option<&serde_json::Value>| side.map_or("unknown".to_owned(), |v| v.to_string());
            format!("{name} is {} there and {} here", show(found.get(name)), show(expected.get(name)))
        })
        .collect();
    if names.is_empty() { "they are written otherwise".to_owned() } else { names.join(", ") }
}

/// The state of a run between two steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    run: RunState,
    learner: LearnerState,
}

impl Checkpoint {
    pub(super) fn new(run: RunState, learner: LearnerState) -> Self {
        Self { run, learner }
    }

    /// Steps done.
    #[must_use]
    pub fn step(&self) -> u32 {
        self.run.step
    }

    /// The same state as one of the run that is `branch`, of the curve that is `trunk`: nothing of it depends on the weight of
    /// the rate, which is all that they differ in.
    ///
    /// # Errors
    /// What differs, if it is a checkpoint of another run or later than where branches begin.
    pub fn fork(mut self, trunk: &TrainOptions, branch: &TrainOptions) -> Result<Self, CheckpointError> {
        let expected = options_text(trunk);
        if self.run.options != expected {
            return Err(CheckpointError::Options(differences(&self.run.options, &expected)));
        }
        let text = options_text(branch);
        if !trunk.branches().iter().any(|known| options_text(known) == text) {
            return Err(CheckpointError::Options(differences(&expected, &text)));
        }
        let fork = Schedule::new(trunk).fork_step();
        if self.run.step > fork {
            let fault = format!("step {} is after step {fork}, where branches begin", self.run.step);
            return Err(CheckpointError::Run(fault));
        }
        self.run.options = text;
        self.run.lambda = Schedule::new(branch).lambda().to_bits();
        Ok(self)
    }

    /// Takes it apart for a run of `steps` steps over `frames` photographs from `origin`.
    ///
    /// # Errors
    /// What differs, if it is a checkpoint of another run.
    pub(super) fn open(
        self,
        origin: Origin<'_>,
        steps: u32,
        frames: usize,
    ) -> Result<(RunState, LearnerState), CheckpointError> {
        self.run.check(origin, steps, frames)?;
        Ok((self.run, self.learner))
    }

    /// Writes the file's bytes.
    ///
    /// # Errors
    /// Those of `out`.
    pub fn write(&self, out: &mut impl io::Write) -> io::Result<()> {
        let run = serde_json::to_string(&self.run)?;
        let arrays = &self.learner.0;
        let checksum = arrays.iter().fold(crc32c::crc32c(run.as_bytes()), |sum, (name, array)| {
            extend_checksum(sum, name, array.bytes())
        });
        // By hand: the library's writer wants the whole file in memory, or a path whose folder it litters when it is killed.
        let mut header = serde_json::Map::new();
        header.insert(
            "__metadata__".to_owned(),
            json!({ VERSION_KEY: VERSION, CHECKSUM_KEY: format!("{checksum:08x}"), RUN_KEY: run }),
        );
        let mut end = 0;
        for (name, array) in arrays {
            let begin = end;
            end += array.bytes().len();
            let count = array.bytes().len() / 4;
            let entry = json!({ "dtype": array.dtype(), "shape": [count], "data_offsets": [begin, end] });
            header.insert(name.clone(), entry);
        }
        let mut header = serde_json::to_string(&header)?;
        header.extend(std::iter::repeat_n(' ', header.len().next_multiple_of(8) - header.len()));
        out.write_all(&(header.len() as u64).to_le_bytes())?;
        out.write_all(header.as_bytes())?;
        arrays.values().try_for_each(|array| out.write_all(array.bytes()))
    }

    /// Reads the bytes of a file.
    ///
    /// # Errors
    /// [`CheckpointError::Format`], [`CheckpointError::Damaged`] or [`CheckpointError::Version`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, CheckpointError> {
        let format = |fault: SafeTensorError| CheckpointError::Format(fault.to_string());
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(format)?;
        let empty = HashMap::new();
        let metadata = header.metadata().as_ref().unwrap_or(&empty);
        let get = |key: &str| {
            let missing = || CheckpointError::Format(format!("the metadata lack '{key}'"));
            metadata.get(key).ok_or_else(missing)
        };
        let version = get(VERSION_KEY)?;
        if version != VERSION {
            return Err(CheckpointError::Version(version.clone()));
        }
        let (run, stated) = (get(RUN_KEY)?, get(CHECKSUM_KEY)?);
        let tensors = SafeTensors::deserialize(bytes).map_err(format)?;
        let tensors: BTreeMap<String, _> = tensors.tensors().into_iter().collect();
        let found = tensors.iter().fold(crc32c::crc32c(run.as_bytes()), |sum, (name, tensor)| {
            extend_checksum(sum, name, tensor.data())
        });
        if *stated != format!("{found:08x}") {
            return Err(CheckpointError::Damaged { found, stated: stated.clone() });
        }
        let run = serde_json::from_str(run).map_err(|fault| CheckpointError::Format(fault.to_string()))?;
        let arrays = tensors.into_iter().map(|(name, tensor)| {
            let array = Array::from_bytes(tensor.dtype(), tensor.data()).ok_or_else(|| {
                CheckpointError::array(&name, format!("is of type {:?}, which no state has", tensor.dtype()))
            })?;
            Ok((name, array))
        });
        Ok(Self { run, learner: LearnerState(arrays.collect::<Result<_, CheckpointError>>()?) })
    }
}

fn extend_checksum(sum: u32, name: &str, bytes: &[u8]) -> u32 {
    crc32c::crc32c_append(crc32c::crc32c_append(sum, name.as_bytes()), bytes)
}

// Arrays are written as they lie in memory, and safetensors are little-endian.
const _: () = assert!(cfg!(target_endian = "little"));

impl Array {
    fn dtype(&self) -> Dtype {
        match self {
            Array::F32(_) => Dtype::F32,
            Array::I32(_) => Dtype::I32,
            Array::U32(_) => Dtype::U32,
        }
    }

    fn bytes(&self) -> &[u8] {
        match self {
            Array::F32(values) => bytemuck::cast_slice(values),
            Array::I32(values) => bytemuck::cast_slice(values),
            Array::U32(values) => bytemuck::cast_slice(values),
        }
    }

    fn from_bytes(dtype: Dtype, bytes: &[u8]) -> Option<Self> {
        match dtype {
            Dtype::F32 => Some(Array::F32(bytemuck::pod_collect_to_vec(bytes))),
            Dtype::I32 => Some(Array::I32(bytemuck::pod_collect_to_vec(bytes))),
            Dtype::U32 => Some(Array::U32(bytemuck::pod_collect_to_vec(bytes))),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::domain::Preset;

    fn options() -> TrainOptions {
        TrainOptions { seed: 7, lambda: Some(0.1 + 0.2), ..TrainOptions::default() }
    }

    fn origin(options: &TrainOptions) -> Origin<'_> {
        Origin { options, dataset: Digest::of(b"set"), adapter: "an adapter", most: 1000 }
    }

    fn checkpoint() -> Checkpoint {
        let options = options();
        let mut rng = Pcg64::seed_from_u64(7);
        let _: u64 = rng.random();
        let mut run = RunState::begin(origin(&options), rng, 0.002);
        run.step = 30;
        run.seconds = 12.5;
        run.order = vec![3, 0, 2];
        run.set_average(LossSums { ssim: 0.1 + 0.2, l1: 1.0 / 3.0, mse: 1e-300, wavelet: 0.7 });
        let mut learner = LearnerState::default();
        learner.put("rows", vec![1.0_f32, f32::MIN_POSITIVE / 2.0, -0.0]);
        learner.put("cells", vec![-1, i32::MAX]);
        learner.put("masks", vec![u32::MAX]);
        Checkpoint::new(run, learner)
    }

    fn written(checkpoint: &Checkpoint) -> Vec<u8> {
        let mut bytes = Vec::new();
        checkpoint.write(&mut bytes).expect("writes");
        bytes
    }

    #[test]
    fn a_checkpoint_comes_back_bit_for_bit() {
        let bytes = written(&checkpoint());
        let back = Checkpoint::from_bytes(&bytes).expect("reads");
        assert_eq!(back, checkpoint());
        let options = options();
        let (mut run, _) = back.open(origin(&options), 30, 4).expect("of this run");
        let (mut other, _) = checkpoint().open(origin(&options), 30, 4).expect("of this run");
        assert_eq!(run.rng.random::<u64>(), other.rng.random::<u64>());
        assert_eq!(
            run.average(),
            Some(LossSums { ssim: 0.1 + 0.2, l1: 1.0 / 3.0, mse: 1e-300, wavelet: 0.7 })
        );
    }

    #[test]
    fn every_truncation_is_refused() {
        let bytes = written(&checkpoint());
        for length in 0..bytes.len() {
            assert!(Checkpoint::from_bytes(&bytes[..length]).is_err(), "cut to {length}");
        }
        assert!(matches!(Checkpoint::from_bytes(b"no checkpoint at all"), Err(CheckpointError::Format(_))));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(400))]

        #[test]
        fn every_flipped_bit_is_refused_or_changes_nothing(at in any::<prop::sample::Index>(), bit in 0..8_u32) {
            let mut bytes = written(&checkpoint());
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
            if let Ok(read) = Checkpoint::from_bytes(&bytes) {
                prop_assert_eq!(read, checkpoint());
            }
        }
    }

    #[test]
    fn checkpoints_of_other_runs_are_refused_with_what_differs() {
        let options = options();
        let refused = |origin: Origin<'_>, steps, frames| {
            checkpoint().open(origin, steps, frames).expect_err("another run").to_string()
        };
        let other = TrainOptions { seed: 8, preset: Preset::Paper, ..options.clone() };
        let text = refused(origin(&other), 30, 4);
        assert!(text.contains("seed is 7 there and 8 here"), "{text}");
        assert!(text.contains(r#"preset is "preview" there and "paper" here"#), "{text}");
        let text = refused(Origin { dataset: Digest::of(b"other"), ..origin(&options) }, 30, 4);
        assert!(text.contains(&Digest::of(b"other").to_string()), "{text}");
        assert!(refused(origin(&options), 29, 4).contains("step 30 is not one of 1 to 29"));
        assert!(refused(origin(&options), 30, 3).contains("photograph 3 of 3"));
        let elsewhere = Origin { adapter: "another adapter", ..origin(&options) };
        assert!(checkpoint().open(elsewhere, 30, 4).is_ok(), "another adapter may go on");
        let mut moved = checkpoint().run;
        moved.move_to("another adapter", 2000);
        assert_eq!((&*moved.adapter, moved.most), ("another adapter", 1000), "more room is left unused");
        moved.move_to("another adapter", 500);
        assert_eq!(moved.most, 500);
        let mut old = checkpoint();
        old.run.generator = "tcgs 0.0.1".to_owned();
        let fault = old.open(origin(&options), 30, 4).expect_err("another program").to_string();
        assert!(fault.contains("tcgs 0.0.1"), "{fault}");
    }

    #[test]
    fn a_checkpoint_becomes_a_branchs_only_before_branches_part_and_only_a_branch_of_its_own() {
        let trunk =
            TrainOptions { lambda: None, iterations: Some(120), rd_curve: vec![0.004, 0.001], ..options() };
        let at = |step| {
            let mut checkpoint = checkpoint();
            checkpoint.run.options = options_text(&trunk);
            checkpoint.run.step = step;
            checkpoint
        };
        for branch in trunk.branches() {
            let fork = at(40).fork(&trunk, &branch).expect("a branch");
            fork.open(origin(&branch), 120, 4).expect("of the branch's run");
        }
        let branch = &trunk.branches()[0];
        let refused = |checkpoint: Checkpoint, trunk: &TrainOptions, branch: &TrainOptions| {
            checkpoint.fork(trunk, branch).expect_err("refused").to_string()
        };
        let late = refused(at(41), &trunk, branch);
        assert!(late.contains("step 41 is after step 40"), "{late}");
        for other in [
            TrainOptions { lambda: Some(0.002), ..branch.clone() },
            TrainOptions { seed: 8, ..branch.clone() },
        ] {
            refused(at(40), &trunk, &other);
        }
        refused(at(40), &TrainOptions { seed: 8, ..trunk.clone() }, branch);
        refused(checkpoint(), &trunk, branch);
    }

    #[test]
    fn another_version_of_the_layout_is_refused_by_its_number() {
        let mut bytes = written(&checkpoint());
        let key = br#""tcgs.checkpoint":""#;
        let place = bytes.windows(key.len()).position(|window| window == key);
        let at = place.expect("the version") + key.len();
        bytes[at] = b'9';
        let fault = Checkpoint::from_bytes(&bytes).expect_err("refused");
        assert!(matches!(&fault, CheckpointError::Version(version) if version == "9"), "{fault}");
    }
}
