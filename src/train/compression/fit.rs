//! What an encoder may choose from once training is over: the trained context model, and others that are fitted to the same
//! scene, whose attributes no longer change.
//!
//! A scene is trained with the largest context; whether a smaller one takes fewer bytes in all shows in the file. So after the
//! last step networks that see less (the position alone, the anchor's own planes), and smaller planes, learn what they
//! can predict: by rate alone, without rendering, at the steps that training gave the anchors.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{
    Compression, Stage,
    hold::HeldSteps,
    learning::{LEVELS, Modelling, Quantising, outputs_of, sample_of, sample_size},
    steps::{static_adjustments, usual_steps},
};
use crate::{
    domain::{
        AttributeGroup, CancelFlag, ContextCandidates, ContextFrame, ContextKind, PlaneContext,
        context::{GroupNetworks, STEP_OCTAVES},
    },
    gpu::{Buffer, Recorder},
    model::AnchorRows,
    render::DeviceAnchors,
    train::{
        Adam, Decay, TrainError, TrainedContext,
        context::{
            ContextAnchors, ContextConfig, ContextLayout, ContextNet, ContextPass, ContextRates,
            ContextState, GroupStatistics, PlaneConfig, PlaneSource, Quantisation, QuantisationPhase,
            RateTerm, sample_anchors,
        },
    },
};

/// Most anchors in the sample of one step of a fit.
const MOST_SAMPLED: usize = 4096;

/// Steps of a fit for each step of the run, and their bounds: a network settles in a few hundred.
const STEPS_A_STEP: f64 = 1.0 / 6.0;
const LEAST_STEPS: u32 = 10;
const MOST_STEPS: u32 = 600;

/// Rates of networks that begin anew, and of those that were trained.
const FRESH: Decay = Decay { start: 1e-2, end: 1e-4 };
const TRAINED: Decay = Decay { start: 1e-3, end: 1e-5 };

/// How far latents of smaller planes begin from zero: a few of the multiples of 1/16 that are stored.
const FIRST_LATENT: f32 = 0.25;

/// Least edge of planes that are worth a file's while.
const LEAST_EDGE: usize = 8;

/// What all fits share.
struct Fitter<'a> {
    compression: &'a Compression,
    quantising: &'a Quantising,
    frame: ContextFrame,
    statistics: &'a [GroupStatistics; 3],
    anchors: DeviceAnchors,
    cells: &'a [[i32; 3]],
    adam: &'a Adam,
    held: HeldSteps,
    rate: RateTerm,
    void_mark: Buffer<u32>,
    d_rows: Buffer<f32>,
    steps: u32,
    sampled: f64,
    cancel: &'a CancelFlag,
}

impl Compression {
    /// What an encoder may choose from for the finished scene `anchors`, whose anchors are some of those at `before`. None if
    /// the run was too short for a context model.
    ///
    /// # Errors
    /// [`TrainError::Cancelled`] soon after a stop was asked for; faults of the device.
    pub(in crate::train) fn finish(
        mut self,
        adam: &Adam,
        before: &[[i32; 3]],
        anchors: &AnchorRows,
        networks: &[f32],
        cancel: &CancelFlag,
    ) -> Result<Option<TrainedContext>, TrainError> {
        let context = Arc::clone(&self.context);
        if self.schedule.stage(self.schedule.steps) != Stage::Rounded
            && let Some(modelling) = &self.modelling
        {
            let mut recorder = context.recorder("latents of planes");
            modelling.net.latents_from_planes(&mut recorder)?;
            recorder.submit()?;
        }
        self.replace(before, anchors)?;
        let Some(Modelling { frame, statistics, mut net, .. }) = self.modelling.take() else {
            return Ok(None);
        };
        let Some(quantising) = &self.quantising else { return Ok(None) };
        let share = self.schedule.sampled.min(MOST_SAMPLED as f64 / anchors.len().max(1) as f64);
        let capacity = ContextNet::capacity(sample_size(anchors.len(), share));
        let steps = (f64::from(self.schedule.steps) * STEPS_A_STEP) as u32;
        let fitter = Fitter {
            quantising,
            frame,
            statistics: &statistics,
            anchors: DeviceAnchors::upload(&context, anchors, networks)?,
            cells: &anchors.cells,
            adam,
            held: HeldSteps::new(&context, capacity)?,
            rate: RateTerm::new(&context, anchors.shape, capacity)?,
            void_mark: context.buffer("never void", 1)?,
            d_rows: context.buffer("unused gradients of rows", anchors.values.len())?,
            steps: steps.clamp(LEAST_STEPS, MOST_STEPS),
            sampled: share,
            cancel,
            compression: &self,
        };
        // Every anchor's steps as the finished networks have them, not as the last sample that it was in had them.
        fitter.whole_scene(&mut net, Steps::Predicted)?;
        let steps = context.read(quantising.rows.steps())?;
        tracing::debug!(
            anchors = anchors.len(),
            base = ?quantising.base,
            adjustments = ?static_adjustments(&steps, quantising.base, STEP_OCTAVES),
            usual = ?usual_steps(&steps),
            "steps",
        );
        let (position, planes) = fitter.candidates(&net)?;
        Ok(Some(TrainedContext {
            steps: quantising.steps,
            candidates: ContextCandidates {
                frame,
                static_steps: static_adjustments(&steps, quantising.base, STEP_OCTAVES),
                position,
                planes,
            },
        }))
    }
}

/// Whose steps a pass measures at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Steps {
    /// Those that the networks predict, which become the anchors' own.
    Predicted,
    /// Those that the anchors have.
    Held,
}

impl Fitter<'_> {
    /// Networks on positions alone, and planes with the networks on them; `net` is the trained model.
    fn candidates(&self, net: &ContextNet) -> Result<(GroupNetworks, Vec<PlaneContext>), TrainError> {
        let config = net.layout().config;
        let mut net = self.model(config, net.save()?.values)?;
        self.tell("as trained", &mut net)?;
        self.fit(&mut net, false, TRAINED)?;
        self.tell("as fitted", &mut net)?;
        let values = net.save()?.values;
        let trained = networks(net.layout(), &values);
        let Some(planes) = net.layout().stored_planes(&values) else { return Ok((trained, Vec::new())) };
        let position = self.fresh(ContextConfig { kind: ContextKind::Position, ..config }, None)?;
        let position = networks(position.layout(), &position.save()?.values);
        let (own, neighbours) = if config.kind == ContextKind::TriPlaneKnn {
            let config = ContextConfig { kind: ContextKind::TriPlane, ..config };
            let own = self.fresh(config, Some((net.layout(), &values)))?;
            (networks(own.layout(), &own.save()?.values), trained)
        } else {
            (trained, GroupNetworks::default())
        };
        let mut candidates = vec![PlaneContext { planes, own, neighbours }];
        if let Some(planes) = smaller(config.planes) {
            let small = self.fresh(ContextConfig { planes, ..config }, None)?;
            let values = small.save()?.values;
            let fitted = networks(small.layout(), &values);
            let (own, neighbours) = match config.kind {
                ContextKind::TriPlaneKnn => (GroupNetworks::default(), fitted),
                ContextKind::TriPlane | ContextKind::Position => (fitted, GroupNetworks::default()),
            };
            let planes = small.layout().stored_planes(&values);
            candidates.extend(planes.map(|planes| PlaneContext { planes, own, neighbours }));
        }
        Ok((position, candidates))
    }

    /// A model that begins anew, with planes of its own or those of another.
    fn fresh(
        &self,
        config: ContextConfig,
        planes: Option<(&ContextLayout, &[f32])>,
    ) -> Result<ContextNet, TrainError> {
        let layout = ContextLayout::new(config)?;
        let mut rng = Pcg64::seed_from_u64(self.compression.schedule.seed);
        let mut values = layout.initial(self.statistics, &mut rng)?;
        match planes {
            Some((other, from)) => layout.copy_planes(&mut values, other, from)?,
            None => values[layout.latents.clone()]
                .iter_mut()
                .for_each(|value| *value = rng.random_range(-FIRST_LATENT..FIRST_LATENT)),
        }
        let mut net = self.model(config, values)?;
        self.fit(&mut net, planes.is_none(), FRESH)?;
        let name = match (config.kind, planes) {
            (ContextKind::Position, _) => "by position",
            (_, Some(_)) => "by the own planes",
            (_, None) => "by smaller planes",
        };
        self.tell(name, &mut net)?;
        Ok(net)
    }

    /// A model of the scene that remembers nothing of how its parameters came about.
    fn model(&self, config: ContextConfig, values: Vec<f32>) -> Result<ContextNet, TrainError> {
        let mut net = ContextNet::new(&self.compression.context, config, &ContextState::new(values))?;
        net.place(&ContextAnchors::new(&config, &self.frame, self.cells))?;
        Ok(net)
    }

    /// Lets a model learn to predict the scene.
    fn fit(&self, net: &mut ContextNet, planes_learn: bool, decay: Decay) -> Result<(), TrainError> {
        let context = &self.compression.context;
        let schedule = &self.compression.schedule;
        for step in 1..=self.steps {
            let sample = sample_anchors(schedule.seed, step, self.cells.len(), self.sampled);
            let mut recorder = context.recorder("fit of a context");
            self.record(&mut recorder, net, &sample, planes_learn, Steps::Held)?;
            net.backward(&mut recorder)?;
            let rate = decay.at(f64::from(step) / f64::from(self.steps)) as f32;
            let rates = ContextRates { networks: rate, planes: rate, layers: rate, latents: rate };
            net.step(&mut recorder, self.adam, step, &self.void_mark, &rates, self.statistics)?;
            recorder.submit()?;
            if step.is_multiple_of(WAITS_EVERY) {
                context.wait()?;
                if self.cancel.is_cancelled() {
                    return Err(TrainError::Cancelled);
                }
            }
        }
        Ok(())
    }

    /// Records what a sample costs, with the gradients by a model's outputs.
    fn record(
        &self,
        recorder: &mut Recorder<'_>,
        net: &mut ContextNet,
        sample: &[u32],
        planes_learn: bool,
        steps: Steps,
    ) -> Result<(), TrainError> {
        let pass = ContextPass {
            source: PlaneSource::Latents,
            reconstruction: 0.0,
            levels: Some(LEVELS),
            planes_learn,
        };
        net.forward(recorder, sample, &pass)?;
        let Quantising { base, rows, .. } = self.quantising;
        let channels = net.layout().config.channels;
        let (of_sample, outputs) = (sample_of(net, sample.len()), outputs_of(net));
        if steps == Steps::Held {
            self.held.record(recorder, *base, rows.steps(), of_sample, outputs, channels)?;
        }
        let quantisation = Quantisation { phase: QuantisationPhase::Rounded, base_steps: *base, key: 0 };
        self.rate.record(
            recorder,
            &self.anchors,
            rows,
            &quantisation,
            of_sample,
            outputs,
            1.0,
            &self.d_rows,
            &self.void_mark,
        )?;
        if steps == Steps::Held {
            // An octave beside the steps of an anchor counts as a bit for each of its attributes.
            let bit = self.rate.weight(1.0, sample.len());
            let weights = channels.map(|channels| bit * channels as f32);
            self.held.record_gradient(recorder, weights, of_sample, outputs, channels)?;
        }
        Ok(())
    }

    /// Bits of every group over all anchors.
    fn whole_scene(&self, net: &mut ContextNet, steps: Steps) -> Result<[f64; 3], TrainError> {
        let context = &self.compression.context;
        let all: Vec<u32> = (0..self.cells.len() as u32).collect();
        let mut bits = [0.0; 3];
        for sample in all.chunks(self.rate.capacity()) {
            let mut recorder = context.recorder("rate of the scene");
            self.record(&mut recorder, net, sample, false, steps)?;
            recorder.submit()?;
            let sums = self.rate.sums(context)?;
            bits = std::array::from_fn(|group| bits[group] + sums[group]);
        }
        Ok(bits)
    }

    fn tell(&self, what: &str, net: &mut ContextNet) -> Result<(), TrainError> {
        if tracing::enabled!(tracing::Level::DEBUG) {
            let bytes = self.whole_scene(net, Steps::Held)?.map(|bits| (bits / 8.0) as u64);
            tracing::debug!(anchors = self.cells.len(), ?bytes, "attributes {what}");
        }
        Ok(())
    }
}

/// Steps of a fit between two looks at whether it is still wanted.
const WAITS_EVERY: u32 = 16;

/// A model's networks.
fn networks(layout: &ContextLayout, values: &[f32]) -> GroupNetworks {
    AttributeGroup::ALL.map(|group| Some(layout.network(values, group)))
}

/// Planes of half the edge.
fn smaller(planes: PlaneConfig) -> Option<PlaneConfig> {
    let smaller = PlaneConfig { edge: planes.edge / 2, ..planes };
    (smaller.edge >= LEAST_EDGE).then_some(smaller)
}
