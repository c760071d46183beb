//! The box of the initial random points of a dataset without a point cloud.

use glam::{DMat3, DVec3};

use super::{Result, TrainError};
use crate::domain::{Frame, Intrinsics, Layout};

/// Half the side of a Blender set's box, in half the side of what a camera sees at the box's center. With it the published sets have the
/// published box, 1.3 units to each side (METHOD.md §1.1), to 0.5 %.
const SHARE_OF_VIEW: f64 = 0.9;

/// Half the side of other boxes, and the most of a Blender set's, in median distances of the cameras from its center: wide lenses see far
/// beyond what the cameras are turned to.
const MAX_HALF_SIDE: f64 = 0.6;

/// Half the side of a box at whose center all cameras are, in world units: no length is known there.
const HALF_SIDE_WITHOUT_DISTANCE: f64 = 1.0;

/// A cube in which first points lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InitBox {
    pub(super) center: DVec3,
    /// Half the length of an edge, positive.
    pub(super) half: f64,
}

/// The box around the point nearest to all optical axes. In a Blender set, which has an object and no surroundings, it is as large as
/// the part that cameras at the median distance see of it. Neither position nor unit of the scene matters.
pub(super) fn init_box(layout: Layout, frames: &[&Frame]) -> InitBox {
    let center = nearest_to_axes(frames);
    let distance = median(frames.iter().map(|frame| frame.camera.pose.center().distance(center)).collect());
    let view = median(frames.iter().map(|frame| half_view(&frame.camera.intrinsics)).collect());
    let half = match layout {
        Layout::Blender => distance * (SHARE_OF_VIEW * view).min(MAX_HALF_SIDE),
        Layout::Nerfstudio | Layout::Colmap => distance * MAX_HALF_SIDE,
    };
    InitBox { center, half: if half > 0.0 { half } else { HALF_SIDE_WITHOUT_DISTANCE } }
}

impl InitBox {
    /// Lowest and highest corner.
    pub(super) fn corners(&self) -> ([f32; 3], [f32; 3]) {
        ((self.center - self.half).as_vec3().to_array(), (self.center + self.half).as_vec3().to_array())
    }

    /// Refuses a box in the world that is so far out that double precision cannot tell its points apart.
    pub(super) fn expect_resolved(&self) -> Result<()> {
        let distance = self.center.abs().max_element();
        if 2.0 * self.half >= LEAST_STEPS * f64::EPSILON * distance {
            Ok(())
        } else {
            Err(TrainError::FarFromOrigin { distance, side: 2.0 * self.half })
        }
    }
}

/// Least number of steps of double precision across a box.
const LEAST_STEPS: f64 = 65_536.0;

/// Half the longer side of what a camera sees at distance 1.
fn half_view(k: &Intrinsics) -> f64 {
    (f64::from(k.width) / (2.0 * k.fx)).max(f64::from(k.height) / (2.0 * k.fy))
}

/// The middle value, the larger one of two; 0 without any.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// The point with the least sum of squared distances to the optical axes. If the axes are parallel, ahead of the first camera: as far as
/// the cameras are apart, or a world unit if they are in one place.
fn nearest_to_axes(frames: &[&Frame]) -> DVec3 {
    let mut normal = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    // Relative to the cameras' mean: far from the origin, products of coordinates would lose the digits that differ.
    let mean = mean_center(frames);
    for frame in frames {
        let pose = &frame.camera.pose;
        let axis = pose.rotation().transpose() * DVec3::Z;
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        normal += across;
        right += across * (pose.center() - mean);
    }
    if normal.determinant() > 1e-6 * (frames.len() as f64).powi(3) {
        return mean + normal.inverse() * right;
    }
    let apart = 2.0 * radius(frames);
    let ahead = if apart > 0.0 { apart } else { 1.0 };
    frames.first().map_or(DVec3::ZERO, |frame| {
        let pose = &frame.camera.pose;
        pose.center() + ahead * (pose.rotation().transpose() * DVec3::Z)
    })
}

/// The mean of the cameras' places.
fn mean_center(frames: &[&Frame]) -> DVec3 {
    let sum: DVec3 = frames.iter().map(|frame| frame.camera.pose.center()).sum();
    sum / frames.len().max(1) as f64
}

/// The largest distance of a camera from the mean of their places.
pub(super) fn radius(frames: &[&Frame]) -> f64 {
    let mean = mean_center(frames);
    frames.iter().map(|frame| frame.camera.pose.center().distance(mean)).fold(0.0, f64::max)
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
            mask: None,
            split: Split::Train,
        }
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
            let found = init_box(layout, &frames);
            assert!(found.center.distance(target) < 1e-9);
            assert!((found.half - half * 26.0_f64.sqrt()).abs() < 1e-9, "{found:?}");
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
        for unit in [0.1, 1.0, 3.0, 10.0, 100.0] {
            for target in [DVec3::ZERO, DVec3::new(5.0, -7.0, 1.0) * unit, DVec3::new(5e5, 4e6, 0.0)] {
                let frames = around(target, 4.031_128_9 * unit);
                let InitBox { center, half } = init_box(Layout::Blender, &frames.iter().collect::<Vec<_>>());
                assert!(center.distance(target) < 1e-4 * unit, "{unit} {target}: {center}");
                assert!((half / (1.3 * unit) - 1.0).abs() < 0.01, "{unit}: {half}");
            }
        }
    }

    #[test]
    fn wide_lenses_do_not_widen_the_box_beyond_the_cameras() {
        let mut frames = around(DVec3::ZERO, 5.0);
        for frame in &mut frames {
            let wide = Intrinsics { fx: 200.0, fy: 200.0, ..frame.camera.intrinsics };
            frame.camera = Camera::new(wide, frame.camera.pose).expect("a camera");
        }
        let wide = init_box(Layout::Blender, &frames.iter().collect::<Vec<_>>());
        assert!((wide.half - 3.0).abs() < 1e-3, "{wide:?}");
    }

    #[test]
    fn a_box_too_far_out_for_double_precision_is_refused() {
        let at = |distance: f64| {
            let target = DVec3::new(distance, 0.0, 0.0);
            let frames = [DVec3::X, DVec3::Y, -DVec3::X].map(|offset| frame(target + offset, target));
            let frames: Vec<&Frame> = frames.iter().collect();
            init_box(Layout::Nerfstudio, &frames).expect_resolved()
        };
        for distance in [0.0, 1000.0, 4e6, 1e9] {
            assert!(at(distance).is_ok(), "{distance}");
        }
        for distance in [1e12, 1e15] {
            let error = at(distance).expect_err("too far").to_string();
            assert!(error.contains("closer to the origin"), "{error}");
        }
    }

    #[test]
    fn parallel_axes_still_give_a_box_in_any_unit() {
        for unit in [0.01, 1.0, 500.0] {
            let at = |place: DVec3| frame(place * unit, (place + DVec3::X) * unit);
            let ahead = [at(DVec3::ZERO), at(DVec3::Y)];
            let frames: Vec<&Frame> = ahead.iter().collect();
            let InitBox { center, half } = init_box(Layout::Colmap, &frames);
            assert!(half > 0.0 && half.is_finite());
            assert!(center.distance(DVec3::X * unit) < 1e-5 * unit, "{center}");
        }
        let alone = frame(DVec3::ZERO, DVec3::X);
        assert!(init_box(Layout::Colmap, &[&alone]).center.distance(DVec3::X) < 1e-9);
    }
}
