//! The promise of `max_bytes`: of all files of a trained scene that are no larger, the one that looks best.
//!
//! A file is made smaller by coarser quantisation steps and by leaving Gaussians out. Which steps become coarser first is
//! measured by encoding and rendering each attribute group at every rung of its steps ([`path`]); which Gaussians go first, by
//! what each is worth to the training views against its bytes ([`worth`]). The balance between the two is found by search over
//! real files ([`search`]), and what it leaves unused goes to finer steps again, of a group or of the anchors worth most
//! ([`blend`]). So what is promised is promised of the bytes that are written, every one of them. The same scene, views and
//! budget give the same file on one adapter.

mod blend;
mod path;
mod search;
mod worth;

use std::sync::Arc;

use self::{
    blend::Blend,
    path::{Place, Rung, path},
    search::{FINAL_SLACK, FINAL_TRIES, Point, Trials, most, search},
    worth::{Worth, by_worth},
};
use super::run::JobFailure;
use crate::{
    codec::{ContextChoice, ContextSearch, Encoded},
    domain::{AnchorScene, AttributeGroup, Background, ByteBudget, Frame, GroupOctaves, Problem},
    eval::{mean_scores, measure_views, removal_costs},
    gpu::Context,
    render::{RenderError, SceneRenderer},
};

/// Octaves between two steps of the step table.
const OCTAVES_A_STEP: f64 = 7.0 / 32.0;

/// Steps of the step table between two rungs of a group.
const STEPS_A_RUNG: i8 = 2;

/// Rungs of a group beyond its first: up to 11 times as coarse.
const RUNGS: usize = 8;

/// Loss in dB through one group alone beyond which its coarser rungs are not measured: dropping Gaussians is better then.
const MOST_LOSS: f64 = 3.0;

/// What a budget is to be kept with.
pub(super) struct Budgeted<'a> {
    /// Where to render.
    pub(super) context: &'a Arc<Context>,
    /// The trained scene.
    pub(super) scene: &'a AnchorScene,
    /// Its quantisation steps without a budget: features, scalings in world units, offsets.
    pub(super) steps: [f32; 3],
    /// Training views that files are judged by.
    pub(super) judged: &'a [&'a Frame],
    /// Training views that tell what each Gaussian is worth: as many as time allows, since what none of them shows is
    /// dropped first.
    pub(super) probed: &'a [&'a Frame],
    /// What is behind the scene.
    pub(super) background: Background,
    /// Bytes that the file may have.
    pub(super) limit: u64,
}

/// What a file is written from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Draft<'a> {
    /// The scene with fewer Gaussians.
    pub(super) scene: &'a AnchorScene,
    /// By how many steps of the step table features, scalings and offsets are coarser than they would be without a budget.
    pub(super) coarser: [i8; 3],
    /// Which contexts to use.
    pub(super) search: ContextSearch,
    /// The budget that the file states among its options.
    pub(super) stated: Option<u64>,
}

/// Writes drafts. Its answer is a function of the draft.
pub(super) type Write<'a> = dyn FnMut(Draft<'_>) -> Result<Encoded, JobFailure> + 'a;

/// The file of the scene that looks best to the training views within the budget. `alive` is asked throughout; its fault ends
/// the search.
///
/// # Errors
/// `max-bytes-unreachable` if no file of the scene is small enough, with the size of the smallest; faults of `write`, of
/// `alive` and of the renderer.
pub(super) fn fit_bytes(
    budgeted: &Budgeted<'_>,
    write: &mut Write<'_>,
    alive: &mut dyn FnMut() -> Result<(), JobFailure>,
    from_render: fn(RenderError) -> JobFailure,
) -> Result<(Encoded, ByteBudget), JobFailure> {
    let Budgeted { context, scene, background, limit, .. } = *budgeted;
    let free = write(Draft { scene, coarser: [0; 3], search: ContextSearch::Cheapest, stated: Some(limit) })?;
    let free_bytes = free.bytes.len() as u64;
    if free_bytes <= limit {
        let coarser_octaves = GroupOctaves::default();
        let budget = ByteBudget { max_bytes: limit, free_bytes, coarser_octaves, gaussians_dropped: 0 };
        return Ok((free, budget));
    }
    tracing::info!("the file has {free_bytes} bytes; fitting it into {limit}");
    let renderer = SceneRenderer::new(context, scene, background).map_err(from_render)?;
    let (choice, order, path) = (free.context, Vec::new(), Vec::new());
    let mut files = Files { budgeted, write, alive, renderer, from_render, choice, order, path };
    let unit = samples(budgeted.probed);
    files.path = files.measure_path()?;
    let mut go_on = || (files.alive)().is_ok();
    let costs =
        removal_costs(context, scene, budgeted.probed, background, &mut go_on).map_err(from_render)?;
    (files.alive)()?;
    files.order = by_worth(scene, &costs, &free.byte_counts, budgeted.steps);
    let total = files.order.len();
    let places = files.path.len();
    let prices: Vec<f64> = files.path.iter().map(|place| place.price).collect();
    let marginal: Vec<f64> = files.order.iter().map(|worth| worth.price / unit).collect();
    // Where the next byte costs as much by coarser steps as by fewer Gaussians.
    let guess = |most: Option<usize>| match most.and_then(|kept| marginal.get(kept)) {
        Some(price) => prices.iter().rposition(|place| place <= price).unwrap_or(0),
        None => places - 1,
    };
    match search(&mut files, places, total, limit, guess)? {
        Some(point) => {
            let (encoded, coarser) = files.finest(point, &costs.anchors)?;
            let [features, scalings, offsets] = coarser.map(|steps| steps * OCTAVES_A_STEP);
            let budget = ByteBudget {
                max_bytes: limit,
                free_bytes,
                coarser_octaves: GroupOctaves { features, scalings, offsets },
                gaussians_dropped: (total - point.kept) as u64,
            };
            tracing::info!("{} bytes, with {budget:?}", encoded.bytes.len());
            Ok((encoded, budget))
        }
        None => Err(JobFailure::Fail(unreachable_budget(limit, files.smallest()?))),
    }
}

/// Samples of the views, by which a sum of squared errors is a mean.
fn samples(frames: &[&Frame]) -> f64 {
    let samples = |frame: &&Frame| {
        let size = &frame.camera.intrinsics;
        3.0 * f64::from(size.width) * f64::from(size.height)
    };
    frames.iter().map(samples).sum::<f64>().max(1.0)
}

fn unreachable_budget(limit: u64, smallest: u64) -> Problem {
    let detail = format!(
        "no file of this scene has {limit} bytes or fewer: the smallest, of one Gaussian at the coarsest steps, has {smallest} \
         bytes"
    );
    Problem::new(507, "max-bytes-unreachable", "The file cannot be made so small", detail)
        .with_smallest_bytes(smallest)
}

/// The files of one scene.
struct Files<'a, 'b> {
    budgeted: &'a Budgeted<'a>,
    write: &'a mut Write<'b>,
    alive: &'a mut dyn FnMut() -> Result<(), JobFailure>,
    renderer: SceneRenderer,
    from_render: fn(RenderError) -> JobFailure,
    /// The contexts that the whole scene is best coded with.
    choice: ContextChoice,
    order: Vec<Worth>,
    path: Vec<Place>,
}

impl Files<'_, '_> {
    /// Encodes and renders every group at its rungs, the others as they are without a budget.
    fn measure_path(&mut self) -> Result<Vec<Place>, JobFailure> {
        let at = |files: &mut Self, coarser: [i8; 3]| {
            let encoded = files.smaller(files.budgeted.scene, coarser, files.budgeted.limit)?;
            let error = 10.0_f64.powf(-files.psnr(&encoded.scene)? / 10.0);
            Ok::<_, JobFailure>(Rung { bytes: encoded.bytes.len() as u64, error })
        };
        let first = at(self, [0; 3])?;
        let most = first.error * 10.0_f64.powf(MOST_LOSS / 10.0);
        let mut groups: [Vec<Rung>; 3] = [vec![first], vec![first], vec![first]];
        for (group, rungs) in groups.iter_mut().enumerate() {
            for number in 1..=RUNGS {
                let mut coarser = [0; 3];
                coarser[group] = number as i8 * STEPS_A_RUNG;
                let rung = at(self, coarser)?;
                rungs.push(rung);
                if rung.error > most {
                    break;
                }
            }
        }
        let places = path([&groups[0], &groups[1], &groups[2]]);
        tracing::debug!(?groups, ?places, "rungs of features, scalings and offsets, and the path over them");
        Ok(places)
    }

    fn coarser(&self, place: usize) -> [i8; 3] {
        self.path[place].rungs.map(|rung| rung as i8 * STEPS_A_RUNG)
    }

    /// The file of a point with what its place left unused spent, and the steps of the step table by which its groups are
    /// coarser, on average over the anchors. Either on finer steps or on the anchors worth most, whichever looks better.
    fn finest(&mut self, point: Point, costs: &[f64]) -> Result<(Encoded, [f64; 3]), JobFailure> {
        let (file, quality, coarser) = self.finer_steps(point)?;
        let finer = (file, coarser.map(f64::from));
        match self.finer_anchors(point, costs)? {
            Some((file, blended, coarser)) if blended > quality => Ok((file, coarser)),
            _ => Ok(finer),
        }
    }

    /// A point's file with finer steps: places are some steps apart. One step of one group at a time, the one that looks
    /// best, while it fits and looks better.
    fn finer_steps(&mut self, point: Point) -> Result<(Encoded, f64, [i8; 3]), JobFailure> {
        let limit = self.budgeted.limit;
        let mut coarser = self.coarser(point.place);
        let mut best = self.encode(point, limit)?;
        let mut quality = self.psnr(&best.scene)?;
        loop {
            let from = coarser;
            for group in (0..3).filter(|group| from[*group] > 0) {
                let mut finer = from;
                finer[group] -= 1;
                let encoded = self.smaller(&self.kept(point.kept), finer, limit)?;
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

    /// A point's file with as many anchors as fit at the place before, those first that are worth most; none where not one
    /// fits. Attributes that were trained on multiples of their steps suffer from any step between the finest and one at which most
    /// of them are zero, so groups take large strides, of which this is a part.
    fn finer_anchors(
        &mut self,
        point: Point,
        costs: &[f64],
    ) -> Result<Option<(Encoded, f64, [f64; 3])>, JobFailure> {
        let limit = self.budgeted.limit;
        let Some(before) = point.place.checked_sub(1) else { return Ok(None) };
        let [from, to] = [before, point.place].map(|place| self.coarser(place));
        let Some(group) =
            AttributeGroup::ALL.into_iter().find(|group| from[*group as usize] != to[*group as usize])
        else {
            return Ok(None);
        };
        let scene = self.kept(point.kept);
        let coarse = self.encode(point, limit)?.scene;
        let blend = Blend::new(&scene, coarse, group, costs);
        let mut at = |finer: usize| {
            let mut scene = scene.clone();
            blend.apply(&mut scene, finer);
            self.smaller(&scene, from, limit)
        };
        let Some(finer) =
            most(
                blend.anchors(),
                limit,
                FINAL_SLACK,
                FINAL_TRIES,
                |finer| Ok(at(finer)?.bytes.len() as u64),
            )?
        else {
            return Ok(None);
        };
        let file = at(finer)?;
        let quality = self.psnr(&file.scene)?;
        let share = finer as f64 / blend.anchors() as f64;
        let mut coarser = to.map(f64::from);
        coarser[group as usize] += share * (f64::from(from[group as usize]) - coarser[group as usize]);
        tracing::debug!(
            ?point,
            ?group,
            share,
            bytes = file.bytes.len(),
            quality,
            "the worthiest anchors finer"
        );
        Ok(Some((file, quality, coarser)))
    }

    fn encode(&mut self, point: Point, stated: u64) -> Result<Encoded, JobFailure> {
        self.smaller(&self.kept(point.kept), self.coarser(point.place), stated)
    }

    /// The scene with so many Gaussians.
    fn kept(&self, kept: usize) -> AnchorScene {
        let mut scene = self.budgeted.scene.clone();
        scene.masks.fill(false);
        self.order[..kept].iter().for_each(|worth| scene.masks[worth.offset] = true);
        scene
    }

    /// The smaller of two files: one with the contexts of the whole scene, and one without any, which few Gaussians cannot
    /// pay for.
    fn smaller(&mut self, scene: &AnchorScene, coarser: [i8; 3], stated: u64) -> Result<Encoded, JobFailure> {
        (self.alive)()?;
        let mut write = |choice| {
            let search = ContextSearch::Fixed(choice);
            (self.write)(Draft { scene, coarser, search, stated: Some(stated) })
        };
        let without = write(ContextChoice::STATIC)?;
        if self.choice == ContextChoice::STATIC {
            return Ok(without);
        }
        match write(self.choice) {
            Ok(with) if with.bytes.len() <= without.bytes.len() => Ok(with),
            // Steps that networks find may not suit what is left of the scene.
            Ok(_) | Err(JobFailure::Fail(_)) => Ok(without),
            Err(other) => Err(other),
        }
    }

    fn psnr(&mut self, scene: &AnchorScene) -> Result<f64, JobFailure> {
        (self.alive)()?;
        self.renderer.replace(scene).map_err(self.from_render)?;
        let judged = self.budgeted.judged;
        let views =
            measure_views(&mut self.renderer, judged, self.budgeted.background).map_err(self.from_render)?;
        Ok(mean_scores(&views).psnr.unwrap_or(0.0))
    }

    /// Bytes of the smallest file, which states them as its budget: so a run that is given as many can write it.
    fn smallest(&mut self) -> Result<u64, JobFailure> {
        let point = Point { place: self.path.len() - 1, kept: 1 };
        let mut smallest = 0;
        loop {
            let bytes = self.encode(point, smallest)?.bytes.len() as u64;
            if bytes <= smallest {
                return Ok(smallest);
            }
            smallest = bytes;
        }
    }
}

impl Trials for Files<'_, '_> {
    type Fault = JobFailure;

    fn bytes(&mut self, point: Point) -> Result<u64, JobFailure> {
        Ok(self.encode(point, self.budgeted.limit)?.bytes.len() as u64)
    }

    fn quality(&mut self, point: Point) -> Result<f64, JobFailure> {
        let encoded = self.encode(point, self.budgeted.limit)?;
        let psnr = self.psnr(&encoded.scene)?;
        tracing::debug!(?point, bytes = encoded.bytes.len(), psnr, "a file that fits");
        Ok(psnr)
    }
}
