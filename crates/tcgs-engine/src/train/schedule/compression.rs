//! The stages of compression-aware training, in fractions of the run (METHOD.md §4.2).
//!
//! Invariant: the stages follow each other in the order of [`CompressionStage`].

use super::Decay;
use crate::{
    codec::RegressionSearch,
    domain::{Component, ContextKind, ModelKind, Preset, TrainOptions},
};

/// Share of the anchors whose bits a step estimates (METHOD.md §4.5).
const SAMPLE_SHARE: f64 = 0.15;

/// Weight of the planes' reconstruction loss (METHOD.md §4.6).
const RECONSTRUCTION: f32 = 0.01;

/// Default weight of the bits per element in the loss: the published one (METHOD.md §4.8), and a smaller one, with which a run of 10 000
/// steps comes to the PSNR of plain Gaussians.
const PUBLISHED_LAMBDA: f64 = 1e-3;
const DEFAULT_LAMBDA: f64 = 5e-4;

/// The weight of the rate that a preset has by itself.
pub(super) const fn default_lambda(preset: Preset) -> f64 {
    match preset {
        Preset::Preview | Preset::Standard => DEFAULT_LAMBDA,
        Preset::Paper => PUBLISHED_LAMBDA,
    }
}

/// Fewest steps of a run whose planes are stored as latents and up-sampling layers. The layers learn in a third of the run; in runs
/// of 200 to 600 steps, files were 2 to 8 % larger at the same PSNR, on every dataset, than with planes stored directly, which take
/// about 1 kB.
const MIN_STEPS_FOR_LAYERS: u32 = 30_000;

/// Base quantization steps of short runs.
const SHORT: BaseQuantStepRule =
    BaseQuantStepRule::Relative { feature: 0.25, scaling: 0.25, offset: 0.1, finer_octaves: 2.0 };

/// The form in which attributes are rendered, and what the rate term does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum CompressionStage {
    /// Attributes without quantization.
    Plain,
    /// Attributes with uniform noise as wide as the base quantization steps.
    Noise,
    /// The context model and each anchor's own quantization steps learn; the rate term is part of the loss.
    Context,
    /// As decoded: attributes, the networks' weights and the planes' latents are rounded to the values that a file stores.
    Rounded,
}

/// How the base quantization steps of the attribute groups are chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BaseQuantStepRule {
    /// 1 for features, 0.001 world units for scalings, 0.2 for offsets (METHOD.md §4.2).
    Published,
    /// Steps of features and offsets, and of scalings as a share of the median scaling, whatever the unit of the world. The first
    /// noise is finer: in short runs features are still so small that the published noise would hide them, and offsets so near zero
    /// that their spread does not predict the final one.
    Relative {
        /// Of features.
        feature: f32,
        /// Of linear scalings, as a share of their median.
        scaling: f32,
        /// Of offsets.
        offset: f32,
        /// Octaves by which the first noise is finer.
        finer_octaves: f32,
    },
}

impl BaseQuantStepRule {
    /// Octaves by which the first noise is finer than the base steps.
    #[must_use]
    pub fn finer_octaves(&self) -> f32 {
        match self {
            BaseQuantStepRule::Published => 0.0,
            BaseQuantStepRule::Relative { finer_octaves, .. } => *finer_octaves,
        }
    }
}

/// The stages of compression-aware training.
#[derive(Debug, Clone, PartialEq)]
pub struct CompressionSchedule {
    /// First step with noise.
    pub noise_from: u32,
    /// First step of the context model.
    pub context_from: u32,
    /// First step whose loss has the planes' reconstruction.
    pub reconstruct_from: u32,
    /// First step that renders everything rounded.
    pub rounded_from: u32,
    /// Last step.
    pub steps: u32,
    /// How base quantization steps are chosen.
    pub base: BaseQuantStepRule,
    /// Weight of the bits per element in the loss.
    pub lambda: f64,
    /// Seed of noise and samples.
    pub seed: u64,
    /// Share of the anchors in the sample of a step.
    pub sample_share: f64,
    /// Learning rate of planes and of their down- and up-sampling layers, from the context model's first step to the last step.
    pub planes: Decay,
    /// Learning rate of the groups' networks, over the same steps.
    pub networks: Decay,
    /// Weight of the planes' reconstruction loss.
    pub reconstruction: f32,
    /// The inputs of the groups' networks.
    pub kind: ContextKind,
    /// Whether files have regressions within an anchor.
    pub regression: RegressionSearch,
    /// Whether planes are stored as latents and up-sampling layers instead of directly.
    pub compresses_planes: bool,
}

impl CompressionSchedule {
    /// The stages of a job of `steps` steps; none for the baselines.
    pub(in crate::train) fn new(options: &TrainOptions, steps: u32) -> Option<Self> {
        if options.model != ModelKind::Tcgs {
            return None;
        }
        let part = |fraction: f64| (f64::from(steps) * fraction).round() as u32;
        let paper = options.preset == Preset::Paper;
        let learning_rate = Decay::exponential(5e-3, 1e-5);
        Some(Self {
            noise_from: part(0.1) + 1,
            context_from: part(1.0 / 3.0) + 1,
            reconstruct_from: part(0.5) + 1,
            rounded_from: part(0.85) + 1,
            steps,
            base: if paper { BaseQuantStepRule::Published } else { SHORT },
            lambda: options.lambda.unwrap_or_else(|| default_lambda(options.preset)),
            seed: options.seed,
            sample_share: SAMPLE_SHARE,
            planes: learning_rate,
            networks: learning_rate,
            reconstruction: RECONSTRUCTION,
            kind: if !options.has(Component::TriPlane) {
                ContextKind::Position
            } else if !options.has(Component::Knn) {
                ContextKind::TriPlane
            } else {
                ContextKind::TriPlaneKnn
            },
            regression: RegressionSearch::of(options),
            compresses_planes: options.has(Component::PlaneCompression)
                && (steps >= MIN_STEPS_FOR_LAYERS || options.with.contains(&Component::PlaneCompression)),
        })
    }

    /// The same stages for a scene that has no anchors up to `step`.
    pub(super) fn not_before(self, step: u32) -> Self {
        Self {
            noise_from: self.noise_from.max(step + 1),
            context_from: self.context_from.max(step + 1),
            ..self
        }
    }

    /// The stage of `step`.
    #[must_use]
    pub fn stage(&self, step: u32) -> CompressionStage {
        if step >= self.rounded_from {
            CompressionStage::Rounded
        } else if step >= self.context_from {
            CompressionStage::Context
        } else if step >= self.noise_from {
            CompressionStage::Noise
        } else {
            CompressionStage::Plain
        }
    }

    /// Whether another stage starts after `step`; false for the last step.
    #[must_use]
    pub fn changes_stage_after(&self, step: u32) -> bool {
        step < self.steps && self.stage(step) != self.stage(step + 1)
    }

    /// Progress of the context model's training at `step`: 0 before its first step, 1 at the run's last.
    #[must_use]
    pub fn context_progress(&self, step: u32) -> f64 {
        let before = self.context_from.saturating_sub(1);
        let whole = self.steps.saturating_sub(before).max(1);
        f64::from(step.saturating_sub(before)) / f64::from(whole)
    }

    /// Weight of the planes' reconstruction loss at `step`.
    #[must_use]
    pub fn reconstruction_at(&self, step: u32) -> f32 {
        let learns = (self.reconstruct_from..self.rounded_from).contains(&step);
        if learns && self.compresses_planes { self.reconstruction } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schedule(options: &TrainOptions) -> CompressionSchedule {
        let steps = crate::train::Schedule::new(options).steps;
        CompressionSchedule::new(options, steps).expect("compression")
    }

    #[test]
    fn a_run_of_30_000_has_the_published_stages_with_the_mended_steps() {
        let paper = schedule(&TrainOptions { preset: Preset::Paper, ..TrainOptions::default() });
        assert_eq!((paper.noise_from, paper.context_from), (3_001, 10_001));
        assert_eq!((paper.reconstruct_from, paper.rounded_from), (15_001, 25_501));
        assert_eq!(paper.base, BaseQuantStepRule::Published);
        assert_eq!((paper.lambda, paper.sample_share, paper.reconstruction), (0.001, 0.15, 0.01));
        assert!((paper.networks.at(paper.context_progress(10_001)) - 5e-3).abs() < 1e-5);
        assert!((paper.planes.at(paper.context_progress(30_000)) - 1e-5).abs() < 1e-12);
        assert_eq!([15_000, 15_001].map(|step| paper.reconstruction_at(step)), [0.0, 0.01]);
        let stages = [1, 3_000, 3_001, 10_000, 10_001, 25_500, 25_501, 30_000].map(|step| paper.stage(step));
        use CompressionStage::{Context, Noise, Plain, Rounded};
        assert_eq!(stages, [Plain, Plain, Noise, Noise, Context, Context, Rounded, Rounded]);
        let turns: Vec<u32> = (0..=30_000).filter(|step| paper.changes_stage_after(*step)).collect();
        assert_eq!(turns, [3_000, 10_000, 25_500]);
    }

    #[test]
    fn stages_keep_their_order_in_the_shortest_runs() {
        for steps in [1, 2, 3, 7, 30, 400] {
            let run = schedule(&TrainOptions { iterations: Some(steps), ..TrainOptions::default() });
            assert!((1..steps).all(|step| run.stage(step) <= run.stage(step + 1)), "{run:?}");
            assert!((0..=steps).all(|step| (0.0..=1.0).contains(&run.context_progress(step))));
        }
    }

    #[test]
    fn planes_go_through_layers_only_where_layers_have_the_steps_to_learn() {
        let of = |steps: u32| schedule(&TrainOptions { iterations: Some(steps), ..TrainOptions::default() });
        let (short, long) = (of(29_999), of(30_000));
        assert!(!short.compresses_planes && long.compresses_planes);
        assert!((1..=29_999).all(|step| short.reconstruction_at(step) == 0.0));
        assert_eq!(long.reconstruction_at(16_000), 0.01);
        let with = [Component::PlaneCompression].into();
        let asked = schedule(&TrainOptions { iterations: Some(300), with, ..TrainOptions::default() });
        assert!(asked.compresses_planes && asked.reconstruction_at(160) == 0.01);
    }

    #[test]
    fn parts_that_are_left_out_are_left_out() {
        let without = |parts: &[Component]| {
            let without = parts.iter().copied().collect();
            schedule(&TrainOptions { without, preset: Preset::Paper, ..TrainOptions::default() })
        };
        assert_eq!(without(&[]).kind, ContextKind::TriPlaneKnn);
        assert_eq!(without(&[Component::Knn]).kind, ContextKind::TriPlane);
        assert_eq!(without(&[Component::TriPlane]).kind, ContextKind::Position);
        assert!(without(&[]).compresses_planes && !without(&[Component::PlaneCompression]).compresses_planes);
        assert_eq!(without(&[Component::PlaneCompression]).reconstruction_at(16_000), 0.0);
        for model in [ModelKind::Scaffold, ModelKind::Gaussians3d] {
            assert_eq!(
                CompressionSchedule::new(&TrainOptions { model, ..TrainOptions::default() }, 100),
                None
            );
        }
    }
}
