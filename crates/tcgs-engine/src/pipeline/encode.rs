//! Writes the file of a trained scene, and reads it back.
//!
//! The kind of file follows the model: `tcgs` is quantized and coded, the baselines are written as floats.

use std::{sync::Arc, time::Instant};

use super::{
    error::JobError,
    inputs::RunInputs,
    quant_steps::choose_quant_steps,
    scene_file::{self, SceneFile},
    size_fit::{EncodeAttempt, SizeFit, fit_size},
};
use crate::{
    codec::{
        self, ContextChoice, ContextSearch, ContextSettings, DecodeLimits, EncodeSettings, Encoded,
        Provenance, RegressionSearch,
    },
    domain::{
        AnchorScene, ByteBudget, CancelFlag, Choices, CodingEfficiency, Dataset, GroupQstepLog2,
        MemoryBudget, ModelKind, Problem, ProblemType, Scene, TrainOptions,
    },
    eval::ColorFit,
    export::world::{Origin, in_world_units},
    gpu::Device,
    train::{BaseQuantSteps, Trained, TrainedContext},
};

/// Training views that decide how finely to quantize.
const STEP_VIEWS: usize = 4;

/// Training views that measure the quality of files of a target size.
const QUALITY_VIEWS: usize = 8;

/// Training views that measure how important each Gaussian is for a target size.
const IMPORTANCE_VIEWS: usize = 64;

/// A file as written, and as it reads back.
pub(super) struct EncodedFile {
    pub(super) bytes: Vec<u8>,
    pub(super) file: SceneFile,
    pub(super) budget: Option<ByteBudget>,
    pub(super) coding: Option<CodingEfficiency>,
    /// Base quantization steps of a file that is coded.
    pub(super) quant_steps: Option<BaseQuantSteps>,
    pub(super) encode_seconds: f64,
    pub(super) decode_seconds: f64,
}

/// Writes the file and reads it back, with the base quantization steps of training, else `quant_steps`, else those that training views
/// choose. Calls `heartbeat` between the parts of a long encoding.
pub(super) fn write_file(
    inputs: &RunInputs<'_>,
    options: &TrainOptions,
    trained: &Trained,
    mut quant_steps: Option<BaseQuantSteps>,
    heartbeat: &mut dyn FnMut(),
) -> Result<EncodedFile, JobError> {
    let started = Instant::now();
    let (background, dataset) = (options.background, Some(inputs.dataset.digest));
    let context = trained.context.as_ref();
    let (bytes, budget, choice) = match (&trained.scene, options.model) {
        (Scene::Anchors(scene), ModelKind::Scaffold) => {
            let bytes = scene_file::write_anchors(scene, background, dataset).map_err(JobError::Fail)?;
            (bytes, None, None)
        }
        (Scene::Anchors(scene), _) => {
            let corrections = trained.corrections.as_deref();
            let encoder = Encoder { inputs, options, context, choices: &trained.choices, corrections };
            let steps = encoder.quant_steps(scene, quant_steps, heartbeat)?;
            quant_steps = Some(steps);
            let (encoded, budget) = encoder.encode(scene, steps, heartbeat)?;
            (encoded.bytes, budget, Some(encoded.context))
        }
        (Scene::Gaussians(scene), _) => {
            let scene = in_world_units(scene, Origin::Nearby);
            (scene_file::write_gaussians(&scene, background, dataset), None, None)
        }
    };
    let encode_seconds = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let file = scene_file::read(&bytes).map_err(|problem| JobError::internal(problem.detail))?;
    let decode_seconds = started.elapsed().as_secs_f64();
    let coding = match choice {
        Some(choice) => {
            // The float networks predict for the quantization steps of training.
            let as_trained = budget.is_none_or(|budget| budget.qstep_log2 == GroupQstepLog2::default());
            coding_efficiency(&bytes, context.filter(|_| as_trained), &choice)?
        }
        None => None,
    };
    Ok(EncodedFile { bytes, file, budget, coding, quant_steps, encode_seconds, decode_seconds })
}

/// The file of a trained scene: `.tcgs`, or the file of a baseline. `dataset` and `options` are those that it was trained with.
///
/// # Errors
/// A [`Problem`]: the scene cannot be coded, does not fit [`TrainOptions::max_bytes`], or the device failed.
pub fn encode(
    device: &Arc<Device>,
    dataset: &Dataset,
    options: &TrainOptions,
    trained: &Trained,
) -> Result<Vec<u8>, Problem> {
    let inputs = RunInputs {
        device: Arc::clone(device),
        dataset,
        budget: MemoryBudget { host: u64::MAX, gpu: device.budget_bytes() },
        cancel: &CancelFlag::default(),
        lpips: None,
        reference: None,
        checkpoint_every: None,
        is_watched: false,
        ingest_seconds: 0.0,
    };
    match write_file(&inputs, options, trained, None, &mut || ()) {
        Ok(written) => Ok(written.bytes),
        Err(JobError::Fail(problem) | JobError::Retry(problem) | JobError::Hold(problem)) => Err(problem),
        Err(JobError::Cancelled) => unreachable!("nothing cancels it"),
    }
}

/// Codes anchors into `.tcgs` files.
struct Encoder<'a> {
    inputs: &'a RunInputs<'a>,
    options: &'a TrainOptions,
    context: Option<&'a TrainedContext>,
    choices: &'a Choices,
    /// As [`Trained::corrections`].
    corrections: Option<&'a [ColorFit]>,
}

impl Encoder<'_> {
    /// The quantization steps of training; `known` ones, else those that training views choose, if the run ended before any were trained.
    fn quant_steps(
        &self,
        scene: &AnchorScene,
        known: Option<BaseQuantSteps>,
        heartbeat: &mut dyn FnMut(),
    ) -> Result<BaseQuantSteps, JobError> {
        let Self { inputs, options, context, .. } = self;
        let steps = match context.map(|context| context.base_quant_steps).or(known) {
            Some(steps) => steps,
            None => {
                let views = inputs.corrected_views(STEP_VIEWS, self.corrections);
                choose_quant_steps(&inputs.device, scene, &views, options.background, &mut || {
                    heartbeat();
                    !inputs.cancel.is_cancelled()
                })?
            }
        };
        inputs.check_cancelled()?;
        Ok(steps)
    }

    /// Codes with these quantization steps, within the target size if there is one.
    fn encode(
        &self,
        scene: &AnchorScene,
        steps: BaseQuantSteps,
        heartbeat: &mut dyn FnMut(),
    ) -> Result<(Encoded, Option<ByteBudget>), JobError> {
        let Self { inputs, options, .. } = self;
        let background = options.background;
        let mut encode = |attempt: EncodeAttempt<'_>| self.encode_attempt(attempt, steps);
        let Some(limit) = options.max_bytes else {
            let search = ContextSearch::Cheapest;
            let attempt = EncodeAttempt { scene, coarser: [0; 3], search, max_bytes: None };
            return Ok((encode(attempt)?, None));
        };
        let target = SizeFit {
            device: &inputs.device,
            scene,
            steps: [steps.feature, steps.scaling * scene.lattice.voxel, steps.offset],
            quality_views: &inputs.corrected_views(QUALITY_VIEWS, self.corrections),
            importance_views: &inputs.corrected_views(IMPORTANCE_VIEWS, self.corrections),
            background,
            limit,
        };
        let mut check = || {
            heartbeat();
            inputs.check_cancelled()
        };
        let (encoded, budget) = fit_size(&target, &mut encode, &mut check)?;
        Ok((encoded, Some(budget)))
    }

    fn encode_attempt(&self, attempt: EncodeAttempt<'_>, steps: BaseQuantSteps) -> Result<Encoded, JobError> {
        let EncodeAttempt { scene, coarser, search, max_bytes } = attempt;
        let options = TrainOptions { max_bytes, ..self.options.clone() };
        let regression = RegressionSearch::of(&options);
        let settings = EncodeSettings {
            background: self.options.background,
            feature_step: steps.feature,
            scaling_step: steps.scaling,
            offset_step: steps.offset,
            context: ContextSettings { search, regression, coarser },
            provenance: Provenance {
                generator: concat!("tcgs ", env!("CARGO_PKG_VERSION")).to_owned(),
                dataset: Some(self.inputs.dataset.digest),
                adapter: Some(self.inputs.device.adapter_line()),
                settings: self.settings(&options)?,
            },
        };
        codec::encode(scene, self.context.map(|context| &context.candidates), &settings)
            .map_err(|error| JobError::Fail(Problem::new(ProblemType::NotEncodable, error.to_string())))
    }

    /// The options, and what the run chose.
    fn settings(&self, options: &TrainOptions) -> Result<serde_json::Value, JobError> {
        let json = |error: serde_json::Error| JobError::internal(error.to_string());
        let mut settings = serde_json::to_value(options).map_err(json)?;
        if let Some(settings) = settings.as_object_mut() {
            settings.insert("choices".to_owned(), serde_json::to_value(self.choices).map_err(json)?);
        }
        Ok(settings)
    }
}

/// How far the file is above the entropy of its model; `None` if it codes nothing.
fn coding_efficiency(
    bytes: &[u8],
    context: Option<&TrainedContext>,
    choice: &ContextChoice,
) -> Result<Option<CodingEfficiency>, JobError> {
    let trained = context.map(|context| (&context.candidates, choice));
    let efficiency = codec::efficiency(bytes, &DecodeLimits::NONE, trained)
        .map_err(|error| JobError::internal(error.to_string()))?;
    let entropy_overhead = efficiency.entropy_overhead();
    Ok(entropy_overhead
        .is_finite()
        .then(|| CodingEfficiency { entropy_overhead, over_floats: efficiency.over_floats() }))
}
