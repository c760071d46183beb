//! Removes the Gaussians outside of a crop's region from a trained scene.
//!
//! The center of a Gaussian decides, for anchors as for plain Gaussians; an anchor whose Gaussians are all removed is removed with them.
//! Quantization moves centers afterwards by less than a step of their offsets.

use glam::DVec3;
use rayon::prelude::*;

use crate::{
    domain::{AnchorScene, Crop, CropRegion, GaussianScene, PointCloud, Problem, ProblemType, Scene},
    train::Trained,
};

/// Which Gaussians of a scene stay.
pub(super) struct Kept(Vec<bool>);

impl Kept {
    /// Those that a region has.
    ///
    /// # Errors
    /// `empty-crop` if it has none.
    pub(super) fn of(scene: &Scene, region: &CropRegion, crop: &Crop) -> Result<Self, Problem> {
        let kept: Vec<bool> = match scene {
            Scene::Anchors(scene) => (0..scene.masks.len())
                .into_par_iter()
                .map(|offset| scene.masks[offset] && region.contains(offset_center(scene, offset)))
                .collect(),
            Scene::Gaussians(scene) => {
                scene.means.par_iter().map(|mean| region.contains(center(scene, mean))).collect()
            }
        };
        if !kept.contains(&true) {
            let centers: Vec<DVec3> = match scene {
                Scene::Anchors(scene) => (0..scene.masks.len())
                    .filter(|offset| scene.masks[*offset])
                    .map(|offset| offset_center(scene, offset))
                    .collect(),
                Scene::Gaussians(scene) => scene.means.iter().map(|mean| center(scene, mean)).collect(),
            };
            return Err(empty(crop, "Gaussians", &centers));
        }
        Ok(Self(kept))
    }

    /// Removes the others from a trained scene, as it is and before rounding.
    pub(super) fn apply(&self, trained: &mut Trained) {
        trained.scene = self.of_scene(&trained.scene);
        trained.unrounded = trained.unrounded.as_ref().map(|scene| self.of_scene(scene));
    }

    fn of_scene(&self, scene: &Scene) -> Scene {
        match scene {
            Scene::Anchors(scene) => Scene::Anchors(scene.with_offsets(&self.0)),
            Scene::Gaussians(scene) => {
                let indices: Vec<usize> = (0..scene.len()).filter(|index| self.0[*index]).collect();
                Scene::Gaussians(scene.with_only(&indices))
            }
        }
    }
}

/// The Gaussians of a scene whose centers lie in a region.
///
/// # Errors
/// `empty-crop` if it has none.
pub(super) fn of_gaussians(
    scene: &GaussianScene,
    region: &CropRegion,
    crop: &Crop,
) -> Result<GaussianScene, Problem> {
    let centers: Vec<DVec3> = scene.means.iter().map(|mean| center(scene, mean)).collect();
    let kept: Vec<usize> = (0..scene.len()).filter(|index| region.contains(centers[*index])).collect();
    if kept.is_empty() {
        return Err(empty(crop, "Gaussians", &centers));
    }
    Ok(scene.with_only(&kept))
}

/// Refuses a region that has none of a dataset's points, if it has points.
///
/// # Errors
/// `empty-crop`.
pub(super) fn check_points(
    region: &CropRegion,
    crop: &Crop,
    points: Option<&PointCloud>,
) -> Result<(), Problem> {
    let points: Vec<DVec3> =
        points.iter().flat_map(|cloud| &cloud.positions).map(|point| DVec3::from(*point)).collect();
    if points.is_empty() || points.par_iter().any(|point| region.contains(*point)) {
        return Ok(());
    }
    Err(empty(crop, "points of the dataset", &points))
}

/// The world's coordinates of a Gaussian.
fn center(scene: &GaussianScene, mean: &[f32; 3]) -> DVec3 {
    scene.frame.to_world(DVec3::from(mean.map(f64::from)))
}

/// The world's coordinates of the Gaussian of an offset, by its place among the masks.
fn offset_center(scene: &AnchorScene, offset: usize) -> DVec3 {
    scene.frame.to_world(DVec3::from(scene.gaussian_center(offset).map(f64::from)))
}

fn empty(crop: &Crop, what: &str, centers: &[DVec3]) -> Problem {
    let least = centers.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let greatest = centers.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let count = centers.len();
    let detail = match crop {
        Crop::Cameras => format!(
            "none of the {count} {what} is in view of half of the training cameras, which look at different places; state a box, or \
             leave out the crop"
        ),
        crop => format!(
            "none of the {count} {what} lies in the box {crop}; they lie between {least:.6} and {greatest:.6} in the dataset's world, so \
             state a box that has some of them"
        ),
    };
    Problem::new(ProblemType::EmptyCrop, detail)
}
