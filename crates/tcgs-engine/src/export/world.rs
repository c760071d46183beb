//! Plain Gaussians in world units, as other programs expect them.
//!
//! Coordinates are those of the world. Of a scene so far out that single precision would lose detail they are relative to an offset,
//! which stays in the scene's frame and which the file states where its format can; world coordinates are then written only on demand.

use glam::DVec3;
use serde::Serialize;

use crate::domain::{GaussianScene, NearPlane, SceneFrame};

/// Where the coordinates of an exported scene begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Origin {
    /// At the world's origin, but at the scene's own where that is too far out for single precision.
    #[default]
    Nearby,
    /// At the world's origin in every case.
    World,
}

/// Loss of precision of world coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Rounding {
    /// Mean distance that single precision moves a Gaussian by, in world units.
    pub mean_shift: f64,
    /// The same in standard deviations of the Gaussian along its shortest axis but one: flat Gaussians count by what is seen of them.
    pub mean_shift_in_deviations: f64,
}

/// The same Gaussians in world units, with their coordinates from `origin` on.
#[must_use]
pub fn in_world_units(scene: &GaussianScene, origin: Origin) -> GaussianScene {
    let frame = scene.frame;
    if frame.is_world() {
        return scene.clone();
    }
    let offset = offset_of(frame, origin);
    let place = frame.offset() - offset;
    let mean = |mean: &[f32; 3]| (place + frame.scale() * wide(*mean)).as_vec3().to_array();
    let longer = frame.scale().ln();
    let log_scales = scene.log_scales.iter();
    let log_scales = log_scales.map(|log| log.map(|log| (f64::from(log) + longer) as f32)).collect();
    let near = NearPlane::new((f64::from(scene.near.depth()) * frame.scale()) as f32);
    GaussianScene {
        frame: SceneFrame::new(offset, 1.0).unwrap_or_default(),
        means: scene.means.iter().map(mean).collect(),
        log_scales,
        near: near.unwrap_or(scene.near),
        ..scene.clone()
    }
}

/// World coordinates of the point that exported coordinates are relative to.
fn offset_of(frame: SceneFrame, origin: Origin) -> DVec3 {
    match origin {
        Origin::Nearby if frame.is_far_out() => frame.offset(),
        Origin::Nearby | Origin::World => DVec3::ZERO,
    }
}

/// What world coordinates lose of a scene in single precision.
#[must_use]
pub fn rounding(scene: &GaussianScene) -> Rounding {
    let mut sums = [0.0; 2];
    for (mean, log_scale) in scene.means.iter().zip(&scene.log_scales) {
        let exact = scene.frame.to_world(wide(*mean));
        let shift = (exact.as_vec3().as_dvec3() - exact).length();
        let mut deviations = log_scale.map(|log| f64::from(log).exp() * scene.frame.scale());
        deviations.sort_by(f64::total_cmp);
        sums[0] += shift;
        sums[1] += shift / deviations[1].max(f64::MIN_POSITIVE);
    }
    let count = scene.len().max(1) as f64;
    let [mean_shift, mean_shift_in_deviations] = sums.map(|sum| sum / count);
    Rounding { mean_shift, mean_shift_in_deviations }
}

fn wide(point: [f32; 3]) -> DVec3 {
    DVec3::from(point.map(f64::from))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::gaussians::SH_COEFFICIENTS;

    fn scene(offset: DVec3, scale: f64) -> GaussianScene {
        GaussianScene {
            frame: SceneFrame::new(offset, scale).expect("a frame"),
            means: vec![[0.5, -1.25, 0.1], [3.0, 2.0, -0.3]],
            log_scales: vec![[-3.0, -2.0, -4.0]; 2],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.5; 2],
            sh: vec![[[0.25; 3]; SH_COEFFICIENTS]; 2],
            degree: 3,
            near: NearPlane::DEFAULT,
        }
    }

    #[test]
    fn lengths_are_the_worlds_and_places_too_unless_they_are_far_out() {
        for (offset, scale, from) in [
            (DVec3::new(1.0, 2.0, 3.0), 2.5, DVec3::ZERO),
            (DVec3::new(5e5, 4e6, 10.0), 1.5, DVec3::new(5e5, 4e6, 10.0)),
        ] {
            let source = scene(offset, scale);
            let world = in_world_units(&source, Origin::Nearby);
            assert_eq!((world.frame.offset(), world.frame.scale()), (from, 1.0));
            for (before, after) in source.means.iter().zip(&world.means) {
                let (before, after) =
                    (source.frame.to_world(wide(*before)), world.frame.to_world(wide(*after)));
                assert!((before - after).length() < 1e-6, "{before} {after}");
            }
            let longer = world.log_scales[0][1] - source.log_scales[0][1];
            assert!((f64::from(longer) - scale.ln()).abs() < 1e-6);
            assert!((f64::from(world.near.depth()) - 0.2 * scale).abs() < 1e-6);
            world.check().expect("sound");
        }
    }

    #[test]
    fn world_coordinates_are_forced_and_their_loss_is_known() {
        let source = scene(DVec3::new(5e5, 4e6, 10.0), 1.5);
        let forced = in_world_units(&source, Origin::World);
        assert!(forced.frame.is_world());
        // A step of single precision at four million is a quarter.
        let lost = rounding(&source);
        assert!((0.01..0.25).contains(&lost.mean_shift), "{lost:?}");
        assert!(lost.mean_shift_in_deviations > lost.mean_shift, "{lost:?}");
        assert!(rounding(&scene(DVec3::ONE, 1.5)).mean_shift < 1e-6);
    }

    #[test]
    fn a_scene_in_the_worlds_frame_stays_as_it_is() {
        let source = GaussianScene { frame: SceneFrame::WORLD, ..scene(DVec3::ZERO, 1.0) };
        assert_eq!(in_world_units(&source, Origin::World), source);
    }
}
