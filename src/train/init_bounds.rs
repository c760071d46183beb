//! The box of the initial random points of a dataset without a point cloud.

use glam::{DMat3, DVec3};

use super::{Result, TrainError};
use crate::domain::{Frame, Intrinsics, Layout};

/// Half the side of the published box of NeRF-synthetic sets (METHOD.md §1.1). Their cameras give it to 0.5 % by the rule below.
const PUBLISHED_HALF_SIDE: f64 = 1.3;

/// How far a box may be from the published one, in its half side, to be that one.
const PUBLISHED_WITHIN: f64 = 0.02;

/// Half the side of a Blender set's box, in half the side of what a camera sees at the box's center.
const SHARE_OF_VIEW: f64 = 0.9;

/// Half the side of other boxes, and the most of a Blender set's, in median distances of the cameras from its center: wide lenses see far
/// beyond what the cameras are turned to.
const MAX_HALF_SIDE: f64 = 0.6;

/// Lowest and highest corner of the box around the point nearest to all optical axes. In a Blender set, which has an object and no
/// surroundings, it is as large as the part that cameras at the median distance see of it. Neither position nor unit of the scene
/// matters. Cameras of the published sets have the published box.
pub(super) fn init_bounds(layout: Layout, frames: &[&Frame]) -> ([f32; 3], [f32; 3]) {
    let center = nearest_to_axes(frames);
    let distance = median(frames.iter().map(|frame| frame.camera.pose.center().distance(center)).collect());
    let view = median(frames.iter().map(|frame| half_view(&frame.camera.intrinsics)).collect());
    let half = match layout {
        Layout::Blender => distance * (SHARE_OF_VIEW * view).min(MAX_HALF_SIDE),
        Layout::Nerfstudio | Layout::Colmap => distance * MAX_HALF_SIDE,
    };
    let off = PUBLISHED_WITHIN * PUBLISHED_HALF_SIDE;
    let is_published = layout == Layout::Blender
        && center.abs().max_element() <= off
        && (half - PUBLISHED_HALF_SIDE).abs() <= off;
    let (center, half) = if is_published {
        (DVec3::ZERO, PUBLISHED_HALF_SIDE)
    } else if half > 0.0 {
        (center, half)
    } else {
        (center, PUBLISHED_HALF_SIDE)
    };
    ((center - half).as_vec3().to_array(), (center + half).as_vec3().to_array())
}

/// Half the longer side of what a camera sees at distance 1.
fn half_view(k: &Intrinsics) -> f64 {
    (f64::from(k.width) / (2.0 * k.fx)).max(f64::from(k.height) / (2.0 * k.fy))
}

/// The middle value, the larger one of two; 0 without any.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
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
    use crate::domain::{Camera, Image, Pose, Split};

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
        // These lenses see half a unit to each side at distance 1.
        for (layout, half) in [(Layout::Nerfstudio, 0.6), (Layout::Colmap, 0.6), (Layout::Blender, 0.45)] {
            let corners = init_bounds(layout, &frames);
            assert!(middle(corners).distance(target) < 1e-4);
            let side = f64::from(corners.1[0] - corners.0[0]);
            assert!((side - 2.0 * half * 26.0_f64.sqrt()).abs() < 1e-3, "{side}");
        }
    }

    /// A hundred views of a target from the upper half of a sphere, with the lens of the NeRF-synthetic sets.
    fn around(target: DVec3, radius: f64) -> Vec<Frame> {
        let view = |index: i32| {
            let (turn, up) = (2.4 * f64::from(index), (f64::from(index) + 0.5) / 100.0);
            let flat = (1.0 - up * up).sqrt();
            let position = target + radius * DVec3::new(flat * turn.cos(), flat * turn.sin(), up);
            let mut frame = frame(position, target);
            let focal = 400.0 / (0.691_111_2_f64 / 2.0).tan();
            let intrinsics =
                Intrinsics { fx: focal, fy: focal, cx: 400.0, cy: 400.0, width: 800, height: 800 };
            frame.camera = Camera::new(intrinsics, frame.camera.pose).expect("a camera");
            frame
        };
        (0..100).map(view).collect()
    }

    #[test]
    fn cameras_of_the_published_sets_have_the_published_box_and_others_its_like_in_any_unit_and_place() {
        let corners = |target: DVec3, unit: f64| {
            let frames = around(target, 4.031_128_9 * unit);
            init_bounds(Layout::Blender, &frames.iter().collect::<Vec<_>>())
        };
        assert_eq!(corners(DVec3::ZERO, 1.0), ([-1.3; 3], [1.3; 3]));
        for unit in [0.1, 3.0, 10.0, 100.0] {
            let target = DVec3::new(5.0, -7.0, 1.0) * unit;
            let (low, high) = corners(target, unit);
            assert!(middle((low, high)).distance(target) < 1e-4 * unit, "{unit}");
            let half = f64::from(high[0] - low[0]) / 2.0;
            assert!((half / (1.3 * unit) - 1.0).abs() < 0.01, "{unit}: {half}");
        }
    }

    #[test]
    fn wide_lenses_do_not_widen_the_box_beyond_the_cameras() {
        let mut frames = around(DVec3::ZERO, 5.0);
        for frame in &mut frames {
            let wide = Intrinsics { fx: 200.0, fy: 200.0, ..frame.camera.intrinsics };
            frame.camera = Camera::new(wide, frame.camera.pose).expect("a camera");
        }
        let (low, high) = init_bounds(Layout::Blender, &frames.iter().collect::<Vec<_>>());
        assert!((f64::from(high[0] - low[0]) - 6.0).abs() < 1e-3, "{low:?} {high:?}");
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
    fn parallel_axes_still_give_a_box() {
        let ahead = [frame(DVec3::ZERO, DVec3::X), frame(DVec3::Y, DVec3::new(1.0, 1.0, 0.0))];
        let frames: Vec<&Frame> = ahead.iter().collect();
        let (low, high) = init_bounds(Layout::Colmap, &frames);
        assert!((0..3).all(|axis| low[axis].is_finite() && low[axis] < high[axis]));
        assert!(middle((low, high)).distance(DVec3::X) < 1e-5);
    }
}
