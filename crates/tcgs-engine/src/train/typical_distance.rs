//! The typical distance of the cameras from the scene's points.

use glam::DVec3;

use crate::domain::Frame;

/// Points that each camera is compared with, an even sample of all: its median is theirs within a few per cent.
const POINTS: usize = 1000;

/// The median distance of the frames' cameras from the points, in world units; zero without cameras or points.
pub(super) fn typical_distance(frames: &[&Frame], points: &[[f64; 3]]) -> f64 {
    let stride = points.len().div_ceil(POINTS).max(1);
    let points: Vec<DVec3> = points.iter().step_by(stride).map(|point| DVec3::from(*point)).collect();
    let mut distances: Vec<f64> = frames
        .iter()
        .map(|frame| frame.camera.pose.center())
        .flat_map(|center| points.iter().map(move |point| center.distance(*point)))
        .collect();
    let middle = distances.len() / 2;
    if middle == distances.len() {
        return 0.0;
    }
    *distances.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Camera, Image, Intrinsics, Pose, Split};

    fn frame(position: DVec3) -> Frame {
        let intrinsics = Intrinsics { fx: 4.0, fy: 4.0, cx: 2.0, cy: 2.0, width: 4, height: 4 };
        let pose = Pose::look_at(position, DVec3::ZERO, DVec3::Z).expect("a view");
        Frame {
            name: format!("{position}"),
            camera: Camera::new(intrinsics, pose).expect("a camera"),
            image: Image::new(4, 4, 3, vec![0; 48]).expect("an image").into(),
            mask: None,
            split: Split::Train,
        }
    }

    #[test]
    fn it_is_the_distance_of_most_cameras_from_most_points_in_any_unit() {
        for unit in [1e-3, 1.0, 1e3] {
            let frames = [DVec3::X, DVec3::Y, DVec3::NEG_X].map(|side| frame(3.0 * unit * side));
            let frames: Vec<&Frame> = frames.iter().collect();
            let near_the_middle = |index: usize| [0.0, 0.0, 0.001 * unit * (index % 7) as f64];
            let mut points: Vec<[f64; 3]> = (0..2500).map(near_the_middle).collect();
            points.extend([[0.0, 0.0, 1e6]; 500]);
            let distance = typical_distance(&frames, &points);
            assert!((distance / unit - 3.0).abs() < 1e-4, "{distance} where a unit is {unit}");
        }
    }

    #[test]
    fn without_points_or_cameras_there_is_none() {
        let one = frame(DVec3::X);
        assert_eq!(typical_distance(&[&one], &[]), 0.0);
        assert_eq!(typical_distance(&[], &[[0.0; 3]]), 0.0);
        assert_eq!(typical_distance(&[&one], &[[1.0, 2.0, 0.0]]), 2.0);
    }
}
