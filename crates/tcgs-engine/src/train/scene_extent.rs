//! The scene's extent, which learning rates of positions, sizes of Gaussians and the near plane are measured in.
//!
//! Invariant: it depends on the dataset alone, so a resumed run has the same.

use super::{init_bounds::radius, scene_frame::TrainingSet, typical_distance::typical_distance};
use crate::domain::Frame;

/// Over the largest distance of a camera from their mean.
const MARGIN: f64 = 1.1;

/// Least extent, in typical distances of the cameras from the scene.
const LEAST: f64 = 0.1;

/// 1.1 times the largest distance of a training camera from the cameras' mean position (METHOD.md §1.1), but at least a tenth of
/// their typical distance from the points, or from the box of random ones: a single camera and those of a tripod have no extent
/// of their own. Positive, in units of the scene's frame.
pub(super) fn scene_extent(set: &TrainingSet) -> f32 {
    let frames: Vec<&Frame> = set.frames.iter().collect();
    let distance = match &set.points {
        Some(points) => {
            let positions: Vec<[f64; 3]> =
                points.positions.iter().map(|point| point.map(f64::from)).collect();
            typical_distance(&frames, &positions)
        }
        None => typical_distance(&frames, &[set.init_box.center.to_array()]),
    };
    let extent = (MARGIN * radius(&frames)).max(LEAST * distance) as f32;
    if extent.is_normal() { extent } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::domain::{
        Camera, Dataset, Digest, Image, Intrinsics, Layout, PointCloud, Pose, SceneFrame, Split,
    };

    fn frame(position: DVec3) -> Frame {
        let intrinsics = Intrinsics { fx: 4.0, fy: 4.0, cx: 2.0, cy: 2.0, width: 4, height: 4 };
        let pose = Pose::look_at(position, DVec3::new(9.0, 9.0, 0.0), DVec3::Z).expect("a view");
        Frame {
            name: format!("{position}"),
            camera: Camera::new(intrinsics, pose).expect("a camera"),
            image: Image::new(4, 4, 3, vec![0; 48]).expect("an image").into(),
            mask: None,
            split: Split::Train,
        }
    }

    /// Of cameras at `centers`, `unit` world units apart, and of points around the origin, if there are any.
    fn extent(centers: &[DVec3], radius: Option<f64>, unit: f64) -> f64 {
        let frames: Vec<Frame> = centers.iter().map(|center| frame(*center * unit)).collect();
        let points = radius.map(|radius| {
            let positions = (0..100)
                .map(|i| DVec3::new(f64::from(i).cos(), f64::from(i).sin(), 0.0) * radius * unit)
                .map(|point| point.to_array());
            PointCloud { positions: positions.collect(), colors: Vec::new() }
        });
        let dataset = Dataset {
            layout: Layout::Nerfstudio,
            frames,
            points,
            digest: Digest::of(b"extent"),
            notes: Vec::new(),
        };
        f64::from(scene_extent(&TrainingSet::of(&dataset, SceneFrame::WORLD).expect("near")))
    }

    #[test]
    fn cameras_around_a_scene_have_the_published_extent() {
        let ring = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y].map(|center| 4.0 * center);
        for unit in [1e-3, 1.0, 1e3] {
            assert!((extent(&ring, Some(1.0), unit) / (4.4 * unit) - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn cameras_of_a_tripod_and_a_single_one_have_a_tenth_of_their_distance() {
        let tripod: Vec<DVec3> = (0..8).map(|i| DVec3::new(1e-3 * f64::from(i), 0.0, 0.0)).collect();
        for unit in [1e-3, 1.0, 1e3] {
            for centers in [&tripod[..], &tripod[..1]] {
                assert!((extent(centers, Some(5.0), unit) / (0.5 * unit) - 1.0).abs() < 0.01);
            }
        }
        // Two optical axes that meet 12.7 units away; a single one has the box a unit ahead.
        let pair = [DVec3::ZERO, DVec3::new(0.1, 0.0, 0.0)];
        assert!((extent(&pair, None, 1.0) - 1.27).abs() < 0.05, "{}", extent(&pair, None, 1.0));
        assert!((extent(&pair[..1], None, 1.0) - 0.1).abs() < 1e-3);
    }
}
