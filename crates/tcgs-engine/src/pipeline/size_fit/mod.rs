//! The target size `max_bytes`: of all files of a trained scene within it, the one with the best quality.
//!
//! Coarser quantization steps and fewer Gaussians make a file smaller. The order in which steps become coarser is measured by
//! encoding and rendering each attribute group at every level of its steps ([`coarsening`]); the order in which Gaussians are
//! dropped follows their importance to the training views per byte ([`importance`]). A search over real files finds the balance
//! between the two ([`size_search`]), and the bytes that it leaves unused go to finer steps again, of a group or of the most important
//! anchors ([`blend`]). So the size that counts is always that of the written file. The same scene, views and target give the
//! same file on one adapter.

mod blend;
mod coarsening;
mod importance;
mod size_search;

use std::sync::Arc;

use self::{
    blend::Blend,
    coarsening::{OperatingPoint, QuantLevel, coarsening_path},
    importance::{Importance, by_importance},
    size_search::{Candidate, FINAL_SLACK, FINAL_TRIES, Trials, largest_fitting, search},
};
use super::error::JobError;
use crate::{
    codec::{ContextChoice, ContextSearch, Encoded},
    domain::{AnchorScene, AttributeGroup, Background, ByteBudget, GroupQstepLog2, Problem, ProblemType},
    eval::{TrainView, mean_psnr, removal_costs},
    gpu::Device,
    render::Renderer,
};

/// Octaves between two entries of the codec's step table.
const OCTAVES_PER_STEP: f64 = 7.0 / 32.0;

/// Entries of the step table between two levels of a group.
const STEPS_PER_LEVEL: i8 = 2;

/// Levels of a group beyond its finest: up to 11 times as coarse.
const LEVELS: usize = 8;

/// Loss in dB through one group alone beyond which its coarser levels are not measured: dropping Gaussians is better then.
const MAX_LOSS: f64 = 3.0;

/// The scene to fit into a target size, and the views that measure its quality.
pub(super) struct SizeFit<'a> {
    pub(super) device: &'a Arc<Device>,
    /// The trained scene.
    pub(super) scene: &'a AnchorScene,
    /// Its quantization steps without a target size: features, scalings in world units, offsets.
    pub(super) steps: [f32; 3],
    /// Training views that the quality of files is measured on.
    pub(super) quality_views: &'a [TrainView<'a>],
    /// Training views that measure the importance of each Gaussian: as many as time allows, since Gaussians that none of them
    /// shows are dropped first.
    pub(super) importance_views: &'a [TrainView<'a>],
    pub(super) background: Background,
    /// The target size in bytes.
    pub(super) limit: u64,
}

/// What one file is encoded from.
#[derive(Debug, Clone, Copy)]
pub(super) struct EncodeAttempt<'a> {
    /// The scene, perhaps with fewer Gaussians.
    pub(super) scene: &'a AnchorScene,
    /// By how many entries of the step table features, scalings and offsets are coarser than without a target size.
    pub(super) coarser: [i8; 3],
    /// Which context models to use.
    pub(super) search: ContextSearch,
    /// The target size that the file states among its options.
    pub(super) max_bytes: Option<u64>,
}

/// Encodes an attempt. Its result is a function of the attempt.
pub(super) type Encode<'a> = dyn FnMut(EncodeAttempt<'_>) -> Result<Encoded, JobError> + 'a;

/// The file of the scene with the best quality within the target size. Calls `check` throughout; an error of it ends the search.
///
/// # Errors
/// `max-bytes-unreachable` if no file of the scene is small enough, with the size of the smallest; errors of `encode`, `check` and
/// the renderer.
pub(super) fn fit_size(
    target: &SizeFit<'_>,
    encode: &mut Encode<'_>,
    check: &mut dyn FnMut() -> Result<(), JobError>,
) -> Result<(Encoded, ByteBudget), JobError> {
    let SizeFit { device, scene, background, limit, .. } = *target;
    let cheapest = ContextSearch::Cheapest;
    let free = encode(EncodeAttempt { scene, coarser: [0; 3], search: cheapest, max_bytes: Some(limit) })?;
    let unconstrained_bytes = free.bytes.len() as u64;
    if unconstrained_bytes <= limit {
        let qstep_log2 = GroupQstepLog2::default();
        let budget = ByteBudget { max_bytes: limit, unconstrained_bytes, qstep_log2, gaussians_dropped: 0 };
        return Ok((free, budget));
    }
    tracing::info!("the file has {unconstrained_bytes} bytes; fitting it into {limit}");
    let renderer = Renderer::new(device, scene, background)?;
    let (choice, order, path) = (free.context, Vec::new(), Vec::new());
    let mut files = Files { target, encode, check, renderer, choice, order, path };
    files.path = files.measure_path()?;
    let mut keep_going = || (files.check)().is_ok();
    let costs = removal_costs(device, scene, target.importance_views, background, &mut keep_going)?;
    (files.check)()?;
    files.order = by_importance(scene, &costs, &free.byte_counts, target.steps);
    let total = files.order.len();
    let points = files.path.len();
    let samples = samples(target.importance_views);
    let prices: Vec<f64> = files.path.iter().map(|point| point.price).collect();
    let marginal: Vec<f64> = files.order.iter().map(|gaussian| gaussian.price / samples).collect();
    // Where the next byte costs as much by coarser steps as by fewer Gaussians.
    let guess = |kept: Option<usize>| match kept.and_then(|kept| marginal.get(kept)) {
        Some(price) => prices.iter().rposition(|point| point <= price).unwrap_or(0),
        None => points - 1,
    };
    match search(&mut files, points, total, limit, guess)? {
        Some(found) => {
            let (encoded, coarser) = files.use_slack(found, &costs.anchors)?;
            let [features, scalings, offsets] = coarser.map(|steps| steps * OCTAVES_PER_STEP);
            let budget = ByteBudget {
                max_bytes: limit,
                unconstrained_bytes,
                qstep_log2: GroupQstepLog2 { features, scalings, offsets },
                gaussians_dropped: (total - found.kept) as u64,
            };
            tracing::info!("{} bytes, with {budget:?}", encoded.bytes.len());
            Ok((encoded, budget))
        }
        None => Err(JobError::Fail(unreachable(limit, files.smallest()?))),
    }
}

/// Number of color samples of the views that count, which turns a sum of squared errors into a mean.
fn samples(views: &[TrainView<'_>]) -> f64 {
    let samples = |view: &TrainView<'_>| 3.0 * view.counted() as f64;
    views.iter().map(samples).sum::<f64>().max(1.0)
}

fn unreachable(limit: u64, smallest: u64) -> Problem {
    let detail = format!(
        "no file of this scene has {limit} bytes or fewer: the smallest, of one Gaussian at the coarsest steps, has {smallest} \
         bytes"
    );
    Problem::new(ProblemType::MaxBytesUnreachable, detail).with_smallest_bytes(smallest)
}

/// The candidate files of one scene.
struct Files<'a, 'b> {
    target: &'a SizeFit<'a>,
    encode: &'a mut Encode<'b>,
    check: &'a mut dyn FnMut() -> Result<(), JobError>,
    renderer: Renderer,
    /// The context models that code the whole scene best.
    choice: ContextChoice,
    /// Gaussians, the most important first.
    order: Vec<Importance>,
    path: Vec<OperatingPoint>,
}

impl Files<'_, '_> {
    /// Encodes and renders every group at its levels, with the other groups as they are without a target size.
    fn measure_path(&mut self) -> Result<Vec<OperatingPoint>, JobError> {
        let measure = |files: &mut Self, coarser: [i8; 3]| {
            let encoded = files.encode_smaller(files.target.scene, coarser, files.target.limit)?;
            let error = 10.0_f64.powf(-files.psnr(&encoded.scene)? / 10.0);
            Ok::<_, JobError>(QuantLevel { bytes: encoded.bytes.len() as u64, error })
        };
        let finest = measure(self, [0; 3])?;
        let max_error = finest.error * 10.0_f64.powf(MAX_LOSS / 10.0);
        let mut groups: [Vec<QuantLevel>; 3] = [vec![finest], vec![finest], vec![finest]];
        for (group, levels) in groups.iter_mut().enumerate() {
            for number in 1..=LEVELS {
                let mut coarser = [0; 3];
                coarser[group] = number as i8 * STEPS_PER_LEVEL;
                let level = measure(self, coarser)?;
                levels.push(level);
                if level.error > max_error {
                    break;
                }
            }
        }
        let path = coarsening_path([&groups[0], &groups[1], &groups[2]]);
        tracing::debug!(?groups, ?path, "levels of features, scalings and offsets, and the path over them");
        Ok(path)
    }

    fn coarser(&self, point: usize) -> [i8; 3] {
        self.path[point].levels.map(|level| level as i8 * STEPS_PER_LEVEL)
    }

    /// The candidate's file with its unused bytes spent on finer steps or on finer values for the most important anchors, whichever
    /// gives the better quality. Also returns by how many entries of the step table each group is coarser, as a mean over the anchors.
    fn use_slack(&mut self, candidate: Candidate, costs: &[f64]) -> Result<(Encoded, [f64; 3]), JobError> {
        let (file, quality, coarser) = self.finer_steps(candidate)?;
        match self.finer_anchors(candidate, costs)? {
            Some((blended, blended_quality, coarser)) if blended_quality > quality => Ok((blended, coarser)),
            _ => Ok((file, coarser.map(f64::from))),
        }
    }

    /// The candidate's file with finer steps, since points of the path are some steps apart. Refines one group by one step at a
    /// time, the one with the best quality, while the file fits and the quality grows.
    fn finer_steps(&mut self, candidate: Candidate) -> Result<(Encoded, f64, [i8; 3]), JobError> {
        let limit = self.target.limit;
        let mut coarser = self.coarser(candidate.point);
        let mut best = self.encode_candidate(candidate, limit)?;
        let mut quality = self.psnr(&best.scene)?;
        loop {
            let from = coarser;
            for group in (0..3).filter(|group| from[*group] > 0) {
                let mut finer = from;
                finer[group] -= 1;
                let encoded = self.encode_smaller(&self.kept(candidate.kept), finer, limit)?;
                if encoded.bytes.len() as u64 > limit {
                    continue;
                }
                let psnr = self.psnr(&encoded.scene)?;
                if psnr > quality {
                    (best, quality, coarser) = (encoded, psnr, finer);
                }
            }
            if coarser == from {
                return Ok((best, quality, coarser));
            }
        }
    }

    /// The candidate's file with the values of the next finer point for as many anchors as fit, the most important first; `None` if
    /// not one fits. Attributes that were trained on multiples of their steps suffer from any step between the finest and one at
    /// which most of them are zero, so points of the path are far apart, and this fills the gap.
    fn finer_anchors(
        &mut self,
        candidate: Candidate,
        costs: &[f64],
    ) -> Result<Option<(Encoded, f64, [f64; 3])>, JobError> {
        let limit = self.target.limit;
        let Some(before) = candidate.point.checked_sub(1) else { return Ok(None) };
        let [from, to] = [before, candidate.point].map(|point| self.coarser(point));
        let Some(group) = AttributeGroup::ALL.into_iter().find(|group| group.of(&from) != group.of(&to))
        else {
            return Ok(None);
        };
        let scene = self.kept(candidate.kept);
        let coarse = self.encode_candidate(candidate, limit)?.scene;
        let blend = Blend::new(&scene, coarse, group, costs);
        let mut encode = |finer: usize| {
            let mut scene = scene.clone();
            blend.apply(&mut scene, finer);
            self.encode_smaller(&scene, from, limit)
        };
        let size = |finer| Ok::<_, JobError>(encode(finer)?.bytes.len() as u64);
        let Some(finer) = largest_fitting(blend.anchors(), limit, FINAL_SLACK, FINAL_TRIES, size)? else {
            return Ok(None);
        };
        let file = encode(finer)?;
        let quality = self.psnr(&file.scene)?;
        let share = finer as f64 / blend.anchors() as f64;
        let mut coarser = to.map(f64::from);
        let of_group = group.of_mut(&mut coarser);
        *of_group += share * (f64::from(*group.of(&from)) - *of_group);
        let bytes = file.bytes.len();
        tracing::debug!(?candidate, ?group, share, bytes, quality, "the most important anchors finer");
        Ok(Some((file, quality, coarser)))
    }

    fn encode_candidate(&mut self, candidate: Candidate, max_bytes: u64) -> Result<Encoded, JobError> {
        self.encode_smaller(&self.kept(candidate.kept), self.coarser(candidate.point), max_bytes)
    }

    /// The scene with only the `kept` most important Gaussians.
    fn kept(&self, kept: usize) -> AnchorScene {
        let mut scene = self.target.scene.clone();
        scene.masks.fill(false);
        self.order[..kept].iter().for_each(|gaussian| scene.masks[gaussian.offset] = true);
        scene
    }

    /// The smaller of two files: one with the context models of the whole scene, and one without any, whose parameters few Gaussians
    /// cannot pay for.
    fn encode_smaller(
        &mut self,
        scene: &AnchorScene,
        coarser: [i8; 3],
        max_bytes: u64,
    ) -> Result<Encoded, JobError> {
        (self.check)()?;
        let mut encode = |choice| {
            let search = ContextSearch::Fixed(choice);
            (self.encode)(EncodeAttempt { scene, coarser, search, max_bytes: Some(max_bytes) })
        };
        let without = encode(ContextChoice::STATIC)?;
        if self.choice == ContextChoice::STATIC {
            return Ok(without);
        }
        match encode(self.choice) {
            Ok(with) if with.bytes.len() <= without.bytes.len() => Ok(with),
            // Steps that networks predict may not suit what is left of the scene.
            Ok(_) | Err(JobError::Fail(_)) => Ok(without),
            Err(other) => Err(other),
        }
    }

    fn psnr(&mut self, scene: &AnchorScene) -> Result<f64, JobError> {
        (self.check)()?;
        self.renderer.replace(scene)?;
        let SizeFit { quality_views, background, .. } = *self.target;
        Ok(mean_psnr(&mut self.renderer, quality_views, background)?)
    }

    /// Bytes of the smallest file, which states them as its target size: a run with that target can write it.
    fn smallest(&mut self) -> Result<u64, JobError> {
        let candidate = Candidate { point: self.path.len() - 1, kept: 1 };
        let mut smallest = 0;
        loop {
            let bytes = self.encode_candidate(candidate, smallest)?.bytes.len() as u64;
            if bytes <= smallest {
                return Ok(smallest);
            }
            smallest = bytes;
        }
    }
}

impl Trials for Files<'_, '_> {
    type Error = JobError;

    fn bytes(&mut self, candidate: Candidate) -> Result<u64, JobError> {
        Ok(self.encode_candidate(candidate, self.target.limit)?.bytes.len() as u64)
    }

    fn quality(&mut self, candidate: Candidate) -> Result<f64, JobError> {
        let encoded = self.encode_candidate(candidate, self.target.limit)?;
        let psnr = self.psnr(&encoded.scene)?;
        tracing::debug!(?candidate, bytes = encoded.bytes.len(), psnr, "a file that fits");
        Ok(psnr)
    }
}

/// A scene with empty networks, whose anchor `i` has `value(i)` in all attributes.
#[cfg(test)]
fn test_scene(
    cells: Vec<[i32; 3]>,
    [feature_dim, offsets_per_anchor]: [usize; 2],
    value: impl Fn(usize) -> f32,
) -> AnchorScene {
    use crate::domain::{Lattice, Mlp, NearPlane, RenderNetworks, SceneFrame, SceneScale};

    let mlp = || Mlp { layers: Vec::new() };
    let rows = |width: usize| (0..cells.len() * width).map(|index| value(index / width)).collect();
    AnchorScene {
        near: NearPlane::DEFAULT,
        scene_scale: SceneScale::DEFAULT,
        frame: SceneFrame::WORLD,
        lattice: Lattice { voxel: 1.0, origin: [0.0; 3] },
        feature_dim,
        offsets_per_anchor,
        features: rows(feature_dim),
        scalings: rows(6),
        offsets: rows(3 * offsets_per_anchor),
        masks: vec![true; cells.len() * offsets_per_anchor],
        networks: RenderNetworks { opacity: mlp(), covariance: mlp(), color: mlp() },
        cells,
    }
}
