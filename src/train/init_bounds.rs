//! The box of the initial random points of a dataset without a point cloud.

use glam::{DMat3, DVec3};

use super::{Result, TrainError};
use crate::domain::{Frame, Layout};

/// Half the side of the box that Blender sets are made in (METHOD.md §1.1).
const BLENDER_HALF_SIDE: f64 = 1.3;

/// Half the side of any other box, in median distances of the cameras from its centre.
const HALF_SIDE: f64 = 0.6;

/// Lowest and highest corner of the box: the published one for Blender datasets, else one around the point nearest to all optical
/// axes, scaled by the cameras' distance from it.
pub(super) fn init_bounds(layout: Layout, frames: &[&Frame]) -> ([f32; 3], [f32; 3]) {
    let (center, half) = match layout {
        Layout::Blender => (DVec3::ZERO, BLENDER_HALF_SIDE),
        Layout::Nerfstudio | Layout::Colmap => {
            let center = nearest_to_axes(frames);
            let mut distances: Vec<f64> =
                frames.iter().map(|frame| frame.camera.pose.center().distance(center)).collect();
            distances.sort_by(f64::total_cmp);
            let median = distances.get(distances.len() / 2).copied().unwrap_or(0.0);
            (center, if median > 0.0 { HALF_SIDE * median } else { BLENDER_HALF_SIDE })
        }
    };
    ((center - half).as_vec3().to_array(), (center + half).as_vec3().to_array())
}

/// Least number of steps of single precision across the box.
const LEAST_STEPS: f32 = 4096.0;

/// Refuses a box whose points single precision cannot tell apart, since it is far from the origin.
pub(super) fn expect_resolved((low, high): ([f32; 3], [f32; 3])) -> Result<()> {
    let side = (0..3).map(|axis| high[axis] - low[axis]).fold(f32::INFINITY, f32::min);
    let distance = low.iter().chain(&high).map(|corner| corner.abs()).fold(0.0, f32::max);
    if side >= LEAST_STEPS * f32::EPSILON * distance {
        Ok(())
    } else {
        Err(TrainError::FarFromOrigin { distance, side })
    }
}

/// The point with the least sum of squared distances to the optical axes, or a unit ahead of the first camera if the axes are
/// parallel.
fn nearest_to_axes(frames: &[&Frame]) -> DVec3 {
    let mut normal = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    for frame in frames {
        let pose = &frame.camera.pose;
        let axis = pose.rotation().transpose() * DVec3::Z;
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        normal += across;
        right += across * pose.center();
    }
    if normal.determinant() > 1e-6 * (frames.len() as f64).powi(3) {
        return normal.inverse() * right;
    }
    frames.first().map_or(DVec3::ZERO, |frame| {
        let pose = &frame.camera.pose;
        pose.center() + pose.rotation().transpose() * DVec3::Z
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Camera, Image, Intrinsics, Pose, Split};

    fn frame(position: DVec3, target: DVec3) -> Frame {
        let intrinsics = Intrinsics { fx: 4.0, fy: 4.0, cx: 2.0, cy: 2.0, width: 4, height: 4 };
        let pose = Pose::look_at(position, target, DVec3::Z).expect("a view");
        Frame {
            name: format!("{position}"),
            camera: Camera::new(intrinsics, pose).expect("a camera"),
            image: Image::new(4, 4, 3, vec![0; 48]).expect("an image").into(),
            split: Split::Train,
        }
    }

    fn middle(corners: ([f32; 3], [f32; 3])) -> DVec3 {
        let (low, high) = corners;
        (DVec3::from(low.map(f64::from)) + DVec3::from(high.map(f64::from))) / 2.0
    }

    #[test]
    fn the_box_is_where_the_cameras_look_and_as_large_as_they_are_far() {
        let target = DVec3::new(100.0, -40.0, 7.0);
        let frames: Vec<Frame> =
            [DVec3::new(5.0, 0.0, 1.0), DVec3::new(0.0, 5.0, 1.0), DVec3::new(-4.0, 3.0, 1.0)]
                .map(|offset| frame(target + offset, target))
                .into();
        let frames: Vec<&Frame> = frames.iter().collect();
        let corners = init_bounds(Layout::Nerfstudio, &frames);
        assert!(middle(corners).distance(target) < 1e-4);
        let side = f64::from(corners.1[0] - corners.0[0]);
        assert!((side - 1.2 * 26.0_f64.sqrt()).abs() < 1e-3, "{side}");
    }

    #[test]
    fn a_box_too_far_out_for_single_precision_is_refused() {
        let at = |distance: f64| {
            let target = DVec3::new(distance, 0.0, 0.0);
            let frames = [DVec3::X, DVec3::Y, -DVec3::X].map(|offset| frame(target + offset, target));
            let frames: Vec<&Frame> = frames.iter().collect();
            expect_resolved(init_bounds(Layout::Nerfstudio, &frames))
        };
        assert!(at(0.0).is_ok() && at(1000.0).is_ok());
        for distance in [1e5, 1e8, 1e9] {
            let error = at(distance).expect_err("too far").to_string();
            assert!(error.contains("closer to the origin"), "{error}");
        }
    }

    #[test]
    fn blender_sets_keep_the_published_box_and_parallel_axes_still_give_one() {
        let ahead = [frame(DVec3::ZERO, DVec3::X), frame(DVec3::Y, DVec3::new(1.0, 1.0, 0.0))];
        let frames: Vec<&Frame> = ahead.iter().collect();
        assert_eq!(init_bounds(Layout::Blender, &frames), ([-1.3; 3], [1.3; 3]));
        let (low, high) = init_bounds(Layout::Colmap, &frames);
        assert!((0..3).all(|axis| low[axis].is_finite() && low[axis] < high[axis]));
        assert!(middle((low, high)).distance(DVec3::X) < 1e-5);
    }
}
