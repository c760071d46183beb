//! The state of a run between two steps, without its model.

use std::collections::BTreeMap;

use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};

use super::{CheckpointError, GENERATOR};
use crate::{
    domain::{Digest, ExposureChoice, ExposureTrial, SceneFrame, TrainOptions},
    train::{LossSums, RateControl, RateControlState},
};

/// The state of a run between two steps, without its model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::train) struct RunState {
    /// Name and version of the program.
    pub(super) generator: String,
    /// The options as JSON. As text, since numbers do not always survive being parsed.
    pub(super) options: String,
    /// Digest of the dataset.
    dataset: Digest,
    /// The bits of the offset and the scale of the scene's frame; none in the world's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    frame: Option<[u64; 4]>,
    /// Adapter and driver; the run may resume on another one, but its bits may differ.
    pub(super) adapter: String,
    /// The size that growth may reach, as limited by the adapter and the memory budget.
    #[serde(rename = "most")]
    pub(in crate::train) max_size: usize,
    /// Steps done.
    pub(in crate::train) step: u32,
    /// Seconds of training so far.
    pub(in crate::train) seconds: f64,
    /// The random generator.
    pub(in crate::train) rng: Pcg64,
    /// Remaining photographs of this epoch, the next one last.
    pub(in crate::train) order: Vec<usize>,
    /// The bits of the averages in progress reports: SSIM, L1, squared error, wavelet bands.
    average: Option<[u64; 4]>,
    /// Whether the run learns color corrections; none where it does not and had no trial.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    exposure: Option<SavedExposure>,
    /// The bits of the rate term's weight in the loss.
    pub(super) lambda: u64,
    /// The state of that weight's controller.
    control: Option<RateControlState>,
    /// The bits (of the f64) of the mean bits of an anchor's attributes, averaged over recent samples.
    anchor_bits: Option<u64>,
    /// Estimated bytes of the file.
    file_bytes: Option<u64>,
    /// What an earlier version stored of a run that it could end early; never written.
    #[serde(default, skip_serializing)]
    scores: Option<EarlyEnd>,
}

/// An [`ExposureChoice`]; of the trial its views, and the bits of its gain and of the gain that was needed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SavedExposure {
    corrected: bool,
    trial: Option<(usize, u64, u64)>,
}

/// How a run with `until=converged` went that an earlier version began.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
struct EarlyEnd {
    converged: Option<Converged>,
}

#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
struct Converged {
    /// The step after which each step passed through three of the schedule.
    step: u32,
}

/// What identifies a run: a checkpoint can only be resumed by the same one.
#[derive(Debug, Clone, Copy)]
pub(in crate::train) struct RunIdentity<'a> {
    pub(in crate::train) options: &'a TrainOptions,
    pub(in crate::train) dataset: Digest,
    pub(in crate::train) adapter: &'a str,
    /// The size that growth may reach.
    pub(in crate::train) max_size: usize,
}

impl RunState {
    /// The state at the start of a run.
    pub(in crate::train) fn new(
        identity: RunIdentity<'_>,
        frame: SceneFrame,
        rng: Pcg64,
        lambda: f64,
    ) -> Self {
        let [x, y, z] = frame.offset().to_array();
        Self {
            frame: (!frame.is_world()).then(|| [x, y, z, frame.scale()].map(f64::to_bits)),
            generator: GENERATOR.to_owned(),
            options: options_text(identity.options),
            dataset: identity.dataset,
            adapter: identity.adapter.to_owned(),
            max_size: identity.max_size,
            step: 0,
            seconds: 0.0,
            rng,
            order: Vec::new(),
            average: None,
            lambda: lambda.to_bits(),
            control: None,
            anchor_bits: None,
            file_bytes: None,
            exposure: None,
            scores: None,
        }
    }

    /// With the choice of the run's color corrections.
    pub(in crate::train) fn with_exposure(self, choice: ExposureChoice) -> Self {
        let ExposureChoice { corrected, trial } = choice;
        let trial =
            trial.map(|ExposureTrial { views, gain, needed }| (views, gain.to_bits(), needed.to_bits()));
        let is_stated = choice != ExposureChoice::OFF;
        Self { exposure: is_stated.then_some(SavedExposure { corrected, trial }), ..self }
    }

    /// Whether the run learns color corrections, and why.
    pub(in crate::train) fn exposure(&self) -> ExposureChoice {
        let Some(SavedExposure { corrected, trial }) = self.exposure else { return ExposureChoice::OFF };
        let trial = trial.map(|(views, gain, needed)| ExposureTrial {
            views,
            gain: f64::from_bits(gain),
            needed: f64::from_bits(needed),
        });
        ExposureChoice { corrected, trial }
    }

    /// Continues the run on an adapter and with a growth limit that may differ from the previous ones. A larger limit is ignored,
    /// since the bits depend on it.
    pub(in crate::train) fn continue_on(&mut self, adapter: &str, max_size: usize) {
        if self.adapter != adapter {
            let before = &self.adapter;
            tracing::warn!(
                "resumed on {adapter}; the checkpoint was written on {before}, so bits may differ"
            );
            adapter.clone_into(&mut self.adapter);
        }
        if max_size < self.max_size {
            let before = self.max_size;
            tracing::warn!("growth limit lowered from {before} to {max_size}; bits may differ");
            self.max_size = max_size;
        }
    }

    /// The state as one of a run of full length: at the step of the schedule that the run has come to.
    pub(super) fn at_full_length(mut self, steps: u32) -> Self {
        if let Some(Converged { step: after }) = self.scores.take().and_then(|run| run.converged) {
            let faster = self.step.saturating_sub(after);
            self.step = self.step.saturating_add(faster.saturating_mul(2)).min(steps);
        }
        self
    }

    /// The scene's frame. Numbers that are none count as the world's, which the check of the state refuses.
    pub(in crate::train) fn frame(&self) -> SceneFrame {
        self.frame.and_then(frame_of_bits).unwrap_or_default()
    }

    /// The averages in progress reports.
    pub(in crate::train) fn average(&self) -> Option<LossSums> {
        let [ssim, l1, mse, wavelet] = self.average?.map(f64::from_bits);
        Some(LossSums { ssim, l1, mse, wavelet })
    }

    /// Adds the losses of a step to them.
    pub(in crate::train) fn observe_losses(&mut self, sums: &LossSums) {
        let blend = |old: f64, new: f64| 0.9 * old + 0.1 * new;
        let LossSums { ssim, l1, mse, wavelet } = self.average().map_or(*sums, |old| LossSums {
            ssim: blend(old.ssim, sums.ssim),
            l1: blend(old.l1, sums.l1),
            mse: blend(old.mse, sums.mse),
            wavelet: blend(old.wavelet, sums.wavelet),
        });
        self.average = Some([ssim, l1, mse, wavelet].map(f64::to_bits));
    }

    /// Weight of the rate term in the loss.
    pub(in crate::train) fn lambda(&self) -> f64 {
        f64::from_bits(self.lambda)
    }

    /// Takes lambda and state from `control`.
    pub(in crate::train) fn set_rate_control(&mut self, control: &RateControl) {
        self.lambda = control.lambda().to_bits();
        self.control = Some(control.state());
    }

    /// The controller in the saved state.
    pub(in crate::train) fn resume_control(&self, control: RateControl) -> RateControl {
        match self.control {
            Some(state) => control.at(state),
            None => control,
        }
    }

    /// Estimated bytes of the file; none before the first sample.
    pub(in crate::train) fn file_bytes(&self) -> Option<u64> {
        self.file_bytes
    }

    /// Updates the estimate of the file's size: an anchor of the last sample takes `anchor_bits` on average, there are `anchors`
    /// anchors, and everything else takes `other_bytes`.
    pub(in crate::train) fn observe_bits(&mut self, anchor_bits: f64, anchors: f64, other_bytes: f64) {
        // One sample is a few hundred anchors, within a few per cent; a longer average would lag behind short runs.
        let mean = self.anchor_bits.map_or(anchor_bits, |old| 0.3 * f64::from_bits(old) + 0.7 * anchor_bits);
        self.anchor_bits = Some(mean.to_bits());
        self.file_bytes = Some((anchors * mean / 8.0 + other_bytes) as u64);
    }

    /// Checks that the run `identity` of `steps` steps over `frames` photographs can resume from this state.
    pub(super) fn check(
        &self,
        identity: RunIdentity<'_>,
        steps: u32,
        frames: usize,
    ) -> Result<(), CheckpointError> {
        if self.generator != GENERATOR {
            return Err(CheckpointError::Generator(self.generator.clone()));
        }
        let expected = options_text(identity.options);
        if self.options != expected {
            return Err(CheckpointError::Options(differences(&self.options, &expected)));
        }
        if self.dataset != identity.dataset {
            return Err(CheckpointError::Dataset { found: self.dataset, expected: identity.dataset });
        }
        if self.frame.is_some_and(|bits| frame_of_bits(bits).is_none()) {
            return Err(CheckpointError::Run("the frame of its scene is not one".to_owned()));
        }
        if !(1..=steps).contains(&self.step) {
            return Err(CheckpointError::Run(format!("step {} is not one of 1 to {steps}", self.step)));
        }
        if let Some(frame) = self.order.iter().find(|frame| **frame >= frames) {
            return Err(CheckpointError::Run(format!("order has photograph {frame} of {frames}")));
        }
        if !(self.seconds.is_finite() && self.seconds >= 0.0) {
            return Err(CheckpointError::Run(format!("time of {} s is impossible", self.seconds)));
        }
        Ok(())
    }
}

fn frame_of_bits(bits: [u64; 4]) -> Option<SceneFrame> {
    let [x, y, z, scale] = bits.map(f64::from_bits);
    SceneFrame::new(glam::DVec3::new(x, y, z), scale)
}

pub(super) fn options_text(options: &TrainOptions) -> String {
    serde_json::to_string(&options.of_training())
        .expect("options have names for keys and nothing that JSON lacks")
}

/// The options that differ, with both values.
pub(super) fn differences(found: &str, expected: &str) -> String {
    let parse = |text| serde_json::from_str::<BTreeMap<String, serde_json::Value>>(text).unwrap_or_default();
    let (found, expected) = (parse(found), parse(expected));
    let names: Vec<String> = found
        .keys()
        .chain(expected.keys().filter(|name| !found.contains_key(*name)))
        .filter(|name| found.get(*name) != expected.get(*name))
        .map(|name| {
            let show =
                |side: Option<&serde_json::Value>| side.map_or("unknown".to_owned(), |v| v.to_string());
            format!(
                "{name} is {} in the checkpoint and {} here",
                show(found.get(name)),
                show(expected.get(name))
            )
        })
        .collect();
    if names.is_empty() { "they are written differently".to_owned() } else { names.join(", ") }
}
