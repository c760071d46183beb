//! Bakes anchors and networks into plain Gaussians, of which only the color depends on the view.
//!
//! In this model opacity, size, rotation and color of a Gaussian all depend on the view (METHOD.md §2.2, §2.3). Plain Gaussians have
//! one opacity, size and rotation, so each Gaussian is evaluated from the given cameras and reduced:
//!
//! - **opacity**: the mean over the views that show it, weighted by the transmittance in front of it (`occlusion`); views in which the
//!   networks emit no Gaussian count as zero. A Gaussian that exists only for one side becomes fainter there and visible from the other
//!   side: most of the loss.
//! - **size**: the mean of its logarithms, weighted by opacity and transmittance in each view;
//! - **rotation**: the mean of the quaternions, signs aligned, weighted alike;
//! - **color**: spherical harmonics by weighted least squares (`fit`), at the directions from each camera to the mean.
//!
//! Gaussians that no view shows with an opacity of 1/255 are dropped. The same scene and cameras give the same bits with any number of
//! threads.

mod fit;
mod networks;
mod occlusion;
mod views;

use glam::DVec3;
use rayon::prelude::*;
use thiserror::Error;

pub use fit::{Coefficients, NormalEquations};
pub use views::{sphere, thinned};

use self::networks::{Evaluated, ViewInputs};
pub(super) use self::{
    occlusion::{Disc, shares},
    views::{BakeView, VIEWS_AT_ONCE},
};
use crate::domain::{
    AnchorScene, Camera, GaussianScene, Mlp, anchors::SceneShapeError, gaussians::SH_COEFFICIENTS, harmonics,
};

/// Opacities below this reach no pixel.
const ALPHA_MIN: f64 = 1.0 / 255.0;

/// Opacities are held this far from one, where the logit would be infinite.
const MAX_OPACITY: f64 = 1.0 - 1e-6;

/// Standard deviations to which a Gaussian reaches.
const CUTOFF_SIGMAS: f64 = 3.0;

/// Least weight of a view that hides the Gaussian, so that a Gaussian hidden in all views has values too.
const MIN_SHARE: f64 = 1.0 / 256.0;

/// Smallest size before its logarithm is taken.
const MIN_SIZE: f64 = 1e-30;

/// How to bake.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BakeSettings {
    /// Highest degree of the spherical harmonics, 0 to 3.
    pub degree: u8,
    /// Weight of the color's roughness against the squared error ([`NormalEquations::solve`]).
    pub ridge: f64,
}

impl Default for BakeSettings {
    fn default() -> Self {
        Self { degree: 3, ridge: 1e-5 }
    }
}

/// The result.
#[derive(Debug, Clone, PartialEq)]
pub struct Baked {
    /// The Gaussians, in the order of anchors and offsets.
    pub scene: GaussianScene,
    /// Offsets that are on but whose Gaussian no view shows.
    pub unseen: usize,
    /// Number of views.
    pub views: usize,
}

/// Why a scene cannot be baked.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum BakeError {
    /// Its parts do not fit together.
    #[error(transparent)]
    Scene(#[from] SceneShapeError),
    /// A degree that plain Gaussians do not have.
    #[error("spherical harmonics of degree {0}; plain Gaussians have 0 to 3")]
    Degree(u8),
    /// No camera is given.
    #[error("no view to bake from")]
    NoViews,
    /// Not one Gaussian is visible.
    #[error("none of the {offsets} offsets makes a Gaussian that one of the {views} views shows")]
    Empty {
        /// Offsets that are on.
        offsets: usize,
        /// Views.
        views: usize,
    },
}

/// The plain Gaussians that look most like the scene from `cameras`, which are in the world; in the scene's frame.
///
/// # Errors
/// [`BakeError`], one variant for each thing that can be wrong.
pub fn bake(scene: &AnchorScene, cameras: &[Camera], settings: BakeSettings) -> Result<Baked, BakeError> {
    scene.check()?;
    if settings.degree > 3 {
        return Err(BakeError::Degree(settings.degree));
    }
    if cameras.is_empty() {
        return Err(BakeError::NoViews);
    }
    let inside = |camera: &Camera| BakeView::of(&scene.frame.camera_from_world(camera));
    let bake_views: Vec<BakeView> = cameras.iter().map(inside).collect();
    let anchors: Vec<AnchorSampler<'_>> = (0..scene.len())
        .map(|anchor| AnchorSampler { scene, bake_views: &bake_views, settings, anchor })
        .collect();
    let mut candidates: Vec<Candidates> = anchors.par_iter().map(AnchorSampler::candidates).collect();
    add_shares(&mut candidates, &bake_views, f64::from(scene.near.depth()));
    let baked: Vec<Vec<Gaussian>> = anchors
        .par_iter()
        .zip(&candidates)
        .map(|(sampler, candidates)| sampler.gaussians(candidates))
        .collect();
    let mut gaussians = GaussianScene {
        degree: settings.degree,
        near: scene.near,
        frame: scene.frame,
        ..GaussianScene::default()
    };
    for gaussian in baked.iter().flatten() {
        gaussians.means.push(gaussian.mean);
        gaussians.log_scales.push(gaussian.log_scale);
        gaussians.quats.push(gaussian.quat);
        gaussians.opacity_logits.push(gaussian.opacity_logit);
        gaussians.sh.push(gaussian.sh);
    }
    if gaussians.is_empty() {
        return Err(BakeError::Empty { offsets: scene.gaussians(), views: cameras.len() });
    }
    Ok(Baked { unseen: scene.gaussians() - gaussians.len(), views: cameras.len(), scene: gaussians })
}

/// A Gaussian in one view.
struct ViewSample {
    /// Column of the networks' outputs.
    column: usize,
    view: usize,
    opacity: f64,
    /// Of its light that reaches the camera.
    share: f64,
}

struct Gaussian {
    mean: [f32; 3],
    log_scale: [f32; 3],
    quat: [f32; 4],
    opacity_logit: f32,
    sh: [[f32; 3]; SH_COEFFICIENTS],
}

/// An offset that may make a Gaussian.
struct Candidate {
    offset: usize,
    disc: Disc,
    /// In each of its anchor's views; zero also where the view does not show it.
    opacities: Vec<f32>,
    /// Of its light that reaches the camera, in each of its anchor's views.
    shares: Vec<f32>,
}

/// The candidates of an anchor.
struct Candidates {
    /// The views that may show one of the anchor's Gaussians, ascending.
    views: Vec<u32>,
    list: Vec<Candidate>,
}

impl Candidates {
    /// The place of a view among those of the anchor.
    fn place(&self, view: usize) -> Option<usize> {
        self.views.binary_search_by(|other| (*other as usize).cmp(&view)).ok()
    }

    /// Opacities of the candidates in a view.
    fn opacities(&self, view: usize) -> impl Iterator<Item = f32> {
        let place = self.place(view);
        self.list.iter().map(move |candidate| place.map_or(0.0, |place| candidate.opacities[place]))
    }
}

/// Adds to each candidate how much of it the views of its anchor show.
fn add_shares(candidates: &mut [Candidates], bake_views: &[BakeView], near: f64) {
    let mut first = Vec::with_capacity(candidates.len());
    let mut discs: Vec<Disc> = Vec::new();
    for anchor in &*candidates {
        first.push(discs.len());
        discs.extend(anchor.list.iter().map(|candidate| candidate.disc));
    }
    for start in (0..bake_views.len()).step_by(VIEWS_AT_ONCE) {
        let views = start..(start + VIEWS_AT_ONCE).min(bake_views.len());
        let shares: Vec<Vec<f32>> = views
            .clone()
            .into_par_iter()
            .map(|view| {
                let opacities: Vec<f32> =
                    candidates.iter().flat_map(|anchor| anchor.opacities(view)).collect();
                occlusion::shares(&bake_views[view], &discs, &opacities, near)
            })
            .collect();
        candidates.par_iter_mut().zip(&first).for_each(|(Candidates { views: of_anchor, list }, first)| {
            for view in of_anchor.iter().map(|view| *view as usize).filter(|view| views.contains(view)) {
                for (index, candidate) in list.iter_mut().enumerate() {
                    candidate.shares.push(shares[view - start][first + index]);
                }
            }
        });
    }
}

/// One anchor evaluated for all views.
struct AnchorSampler<'a> {
    scene: &'a AnchorScene,
    bake_views: &'a [BakeView],
    settings: BakeSettings,
    anchor: usize,
}

impl AnchorSampler<'_> {
    /// Its offsets that are on and at a finite place.
    fn live(&self) -> Vec<(usize, DVec3)> {
        let Self { scene, anchor, .. } = *self;
        (0..scene.offsets_per_anchor)
            .filter(|k| scene.masks[anchor * scene.offsets_per_anchor + k])
            .map(|k| (k, self.mean(k)))
            .filter(|(_, mean)| mean.as_vec3().is_finite())
            .collect()
    }

    /// The views that may show one of the Gaussians at `means`, and the networks' inputs for them.
    fn views<'m>(&self, means: impl Iterator<Item = &'m DVec3> + Clone) -> (Vec<usize>, ViewInputs) {
        let (position, radius) = (self.position(), self.radius());
        let view_degree = self.scene.view_degree().unwrap_or_default();
        let (mut from, mut inputs) = (Vec::new(), ViewInputs::new(view_degree));
        for (view, bake_view) in self.bake_views.iter().enumerate() {
            if means.clone().any(|mean| bake_view.sees(*mean, radius, self.near())) {
                let ray = position - bake_view.center;
                let distance = ray.length().max(1e-12);
                let direction = ray / distance;
                let scaled_distance = distance / f64::from(self.scene.scene_scale.length());
                let of_view = [direction.x, direction.y, direction.z, scaled_distance];
                let of_view = of_view.into_iter().chain(view_degree.harmonics(direction));
                inputs.push(of_view.map(|value| value as f32));
                from.push(view);
            }
        }
        (from, inputs)
    }

    fn network<'n>(&'n self, mlp: &'n Mlp, views: &'n ViewInputs) -> Evaluated<'n> {
        let width = self.scene.feature_dim;
        Evaluated::new(mlp, &self.scene.features[self.anchor * width..][..width], views)
    }

    /// Its offsets that some view shows, with their opacities there.
    fn candidates(&self) -> Candidates {
        let live = self.live();
        let (from, views) = self.views(live.iter().map(|(_, mean)| mean));
        let opacity = self.network(&self.scene.networks.opacity, &views);
        let covariance = self.network(&self.scene.networks.covariance, &views);
        let (size, radius) = (self.size(), self.radius());
        let list = live
            .into_iter()
            .filter_map(|(offset, mean)| {
                let opacity_in = |(view, x): (&usize, f32)| {
                    let is_seen = self.bake_views[*view].sees(mean, radius, self.near());
                    if is_seen { x.tanh().clamp(0.0, 1.0) } else { 0.0 }
                };
                let opacities: Vec<f32> = from.iter().zip(opacity.row(offset)).map(opacity_in).collect();
                let max = opacities.iter().fold(0.0_f32, |max, opacity| max.max(*opacity));
                if f64::from(max) < ALPHA_MIN {
                    return None;
                }
                // The mean over the views of the two larger axes, as one.
                let mut axes = [0, 1, 2].map(|axis| {
                    let parts = covariance.row(7 * offset + axis);
                    let sum: f64 = parts.iter().map(|x| logistic(f64::from(*x))).sum();
                    size[axis] * sum / parts.len().max(1) as f64
                });
                axes.sort_unstable_by(f64::total_cmp);
                let sigma = (axes[1] * axes[2]).sqrt();
                let shares = Vec::with_capacity(from.len());
                Some(Candidate { offset, disc: Disc { mean, sigma }, opacities, shares })
            })
            .collect();
        Candidates { views: from.iter().map(|view| *view as u32).collect(), list }
    }

    /// Its visible Gaussians, by offset, of its candidates with their shares.
    fn gaussians(&self, candidates: &Candidates) -> Vec<Gaussian> {
        let (from, views) = self.views(candidates.list.iter().map(|candidate| &candidate.disc.mean));
        let covariance = self.network(&self.scene.networks.covariance, &views);
        let color = self.network(&self.scene.networks.color, &views);
        let radius = self.radius();
        let rows = |network: &Evaluated<'_>, first: usize, count: usize| -> Vec<Vec<f32>> {
            (first..first + count).map(|row| network.row(row)).collect()
        };
        let places: Vec<Option<usize>> = from.iter().map(|view| candidates.place(*view)).collect();
        candidates
            .list
            .iter()
            .filter_map(|candidate| {
                let mean = candidate.disc.mean;
                let seen: Vec<ViewSample> = from
                    .iter()
                    .enumerate()
                    .filter(|(_, view)| self.bake_views[**view].sees(mean, radius, self.near()))
                    .filter_map(|(column, view)| {
                        let place = places[column]?;
                        Some(ViewSample {
                            column,
                            view: *view,
                            opacity: f64::from(candidate.opacities[place]),
                            share: f64::from(candidate.shares[place]).max(MIN_SHARE),
                        })
                    })
                    .collect();
                let (covariance, color) =
                    (rows(&covariance, 7 * candidate.offset, 7), rows(&color, 3 * candidate.offset, 3));
                self.reduced(mean, &seen, &covariance, &color)
            })
            .collect()
    }

    /// Reduces a Gaussian's samples to one; `None` if it is not finite or too faint.
    fn reduced(
        &self,
        mean: DVec3,
        seen: &[ViewSample],
        covariance: &[Vec<f32>],
        color: &[Vec<f32>],
    ) -> Option<Gaussian> {
        let size = self.size();
        let (mut shown, mut weight) = (0.0, 0.0);
        let (mut log_scale, mut quat) = (DVec3::ZERO, [0.0; 4]);
        let mut normal = NormalEquations::new(self.settings.degree);
        for ViewSample { column, view, opacity, share } in seen {
            shown += share;
            if *opacity < ALPHA_MIN {
                continue;
            }
            let opacity = share * opacity;
            weight += opacity;
            let at = |rows: &[Vec<f32>], row: usize| f64::from(rows[row][*column]);
            let scale = size * DVec3::from([0, 1, 2].map(|axis| logistic(at(covariance, axis))));
            log_scale += opacity * scale.max(DVec3::splat(MIN_SIZE)).map(f64::ln);
            add_rotation(&mut quat, [3, 4, 5, 6].map(|row| at(covariance, row)), opacity);
            let direction = (mean - self.bake_views[*view].center).normalize_or(DVec3::Z);
            // A color is a half plus its harmonics.
            let rgb = [0, 1, 2].map(|channel| logistic(at(color, channel)) - 0.5);
            normal.add(&harmonics::basis(direction), rgb, opacity);
        }
        let opacity = (weight / shown).min(MAX_OPACITY);
        if opacity < ALPHA_MIN {
            return None;
        }
        let sh = normal.solve(self.settings.ridge).map(|rgb| rgb.map(|value| value as f32));
        let length = quat.iter().map(|value| value * value).sum::<f64>().sqrt();
        let quat = if length > 0.0 { quat.map(|value| value / length) } else { [1.0, 0.0, 0.0, 0.0] };
        let gaussian = Gaussian {
            mean: mean.as_vec3().to_array(),
            log_scale: (log_scale / weight).as_vec3().to_array(),
            quat: quat.map(|value| value as f32),
            opacity_logit: (opacity / (1.0 - opacity)).ln() as f32,
            sh,
        };
        let finite = gaussian.log_scale.iter().chain(&gaussian.quat).chain(gaussian.sh.as_flattened());
        finite.copied().all(f32::is_finite).then_some(gaussian)
    }

    /// Gaussians whose mean is at this depth or nearer are not shown.
    fn near(&self) -> f64 {
        f64::from(self.scene.near.depth())
    }

    fn position(&self) -> DVec3 {
        DVec3::from(self.scene.lattice.position(self.scene.cells[self.anchor]).map(f64::from))
    }

    /// Scale of the offsets (0) or base size of the Gaussians (1).
    fn scaling(&self, half: usize) -> DVec3 {
        let scalings = &self.scene.scalings[6 * self.anchor + 3 * half..][..3];
        DVec3::new(f64::from(scalings[0]), f64::from(scalings[1]), f64::from(scalings[2]))
    }

    fn size(&self) -> DVec3 {
        self.scaling(1)
    }

    /// Largest extent of its Gaussians from their means.
    fn radius(&self) -> f64 {
        CUTOFF_SIGMAS * self.size().max_element()
    }

    fn mean(&self, k: usize) -> DVec3 {
        let offset = &self.scene.offsets[3 * (self.anchor * self.scene.offsets_per_anchor + k)..][..3];
        let offset = DVec3::new(f64::from(offset[0]), f64::from(offset[1]), f64::from(offset[2]));
        self.position() + offset * self.scaling(0)
    }
}

/// Adds a rotation to a weighted sum of them; `q` and `-q` are the same one.
fn add_rotation(sum: &mut [f64; 4], quat: [f64; 4], weight: f64) {
    let length = quat.iter().map(|value| value * value).sum::<f64>().sqrt();
    if !(length > 0.0 && length.is_finite()) {
        return;
    }
    let aligned: f64 = sum.iter().zip(quat).map(|(a, b)| a * b).sum();
    let weight = if aligned < 0.0 { -weight } else { weight } / length;
    sum.iter_mut().zip(quat).for_each(|(sum, value)| *sum += weight * value);
}

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests;
