//! The frame that a dataset's scene is trained in, and the dataset in it.
//!
//! Invariants: the frame depends on cameras and points alone, and follows their place and unit; every length that training knows is
//! one of the frame.

use glam::{DVec3, Vec3};

use super::{
    Result,
    init_bounds::{InitBox, init_box},
    typical_distance::typical_distance,
};
use crate::domain::{Dataset, Frame, PointCloud, SceneFrame, Split};

/// The training photographs and the points of a dataset, in the frame of its scene.
pub(super) struct TrainingSet {
    /// With cameras in the frame.
    pub(super) frames: Vec<Frame>,
    /// In the frame; none in a dataset without points.
    pub(super) points: Option<Points>,
    /// Where random points lie in a dataset without any; in the frame.
    pub(super) init_box: InitBox,
}

/// Points in the frame of a scene, finite if those of the dataset are.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Points {
    pub(super) positions: Vec<[f32; 3]>,
    /// sRGB colors, as many as positions, or none.
    pub(super) colors: Vec<[u8; 3]>,
}

/// The frame of a dataset's scene: around the middle of its points, or of the box of random ones without any, with the typical
/// distance of the training cameras from it as its unit; the world's unit where that is no length.
pub(super) fn scene_frame(dataset: &Dataset) -> SceneFrame {
    let frames: Vec<&Frame> = dataset.split(Split::Train).collect();
    let (center, distance) = match &dataset.points {
        Some(cloud) if !cloud.positions.is_empty() => {
            (middle(&cloud.positions), typical_distance(&frames, &cloud.positions))
        }
        _ => {
            let InitBox { center, .. } = init_box(dataset.layout, &frames);
            (center, typical_distance(&frames, &[center.to_array()]))
        }
    };
    let frame =
        SceneFrame::around(center, distance).or_else(|| SceneFrame::new(center, 1.0)).unwrap_or_default();
    tracing::debug!(offset = ?frame.offset(), scale = frame.scale(), "frame of the scene");
    frame
}

/// The median of each coordinate, the larger of two: a point far from all others does not move it.
fn middle(positions: &[[f64; 3]]) -> DVec3 {
    DVec3::from([0, 1, 2].map(|axis| {
        let mut along: Vec<f64> = positions.iter().map(|position| position[axis]).collect();
        let at = along.len() / 2;
        *along.select_nth_unstable_by(at, f64::total_cmp).1
    }))
}

impl TrainingSet {
    /// The training photographs and points of `dataset` in `frame`.
    ///
    /// # Errors
    /// [`super::TrainError::FarFromOrigin`] if there are no points and random ones cannot be told apart in the world.
    pub(super) fn of(dataset: &Dataset, frame: SceneFrame) -> Result<Self> {
        let inside = |photograph: &Frame| Frame {
            camera: frame.camera_from_world(&photograph.camera),
            ..photograph.clone()
        };
        let points = dataset.points.as_ref().filter(|cloud| !cloud.positions.is_empty());
        let in_world = init_box(dataset.layout, &dataset.split(Split::Train).collect::<Vec<_>>());
        if points.is_none() {
            in_world.expect_resolved()?;
        }
        let InitBox { center, half } = in_world;
        Ok(Self {
            frames: dataset.split(Split::Train).map(inside).collect(),
            points: points.map(|cloud| Points::of(cloud, frame)),
            init_box: InitBox { center: frame.from_world(center), half: half / frame.scale() },
        })
    }
}

impl Points {
    /// Without the points of `cloud` that single precision cannot hold in the frame.
    fn of(cloud: &PointCloud, frame: SceneFrame) -> Self {
        let inside = |position: &[f64; 3]| frame.from_world(DVec3::from(*position)).as_vec3();
        let positions: Vec<Vec3> = cloud.positions.iter().map(inside).collect();
        // One that is not finite in the world is no matter of the frame: the first model refuses it by its number.
        let is_kept = |(inside, given): (&Vec3, &[f64; 3])| {
            inside.is_finite() || !given.iter().all(|coordinate| coordinate.is_finite())
        };
        let kept: Vec<bool> = positions.iter().zip(&cloud.positions).map(is_kept).collect();
        let too_far = kept.iter().filter(|kept| !**kept).count();
        if too_far > 0 {
            tracing::warn!("{too_far} points are left out, since they are too far from the scene");
        }
        fn only<T: Copy, U>(values: &[T], kept: &[bool], of: impl Fn(T) -> U) -> Vec<U> {
            values.iter().zip(kept).filter(|(_, kept)| **kept).map(|(value, _)| of(*value)).collect()
        }
        Self {
            positions: only(&positions, &kept, |position| position.to_array()),
            colors: only(&cloud.colors, &kept, |color| color),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Camera, Digest, Image, Intrinsics, Layout, Pose, scene_frame::TYPICAL_DISTANCE};

    fn dataset(points: bool, factor: f64, offset: DVec3) -> Dataset {
        let intrinsics = Intrinsics { fx: 4.0, fy: 4.0, cx: 2.0, cy: 2.0, width: 4, height: 4 };
        let frame = |index: i32| {
            let turn = 0.7 * f64::from(index);
            let place = DVec3::new(3.0 * turn.cos(), 3.0 * turn.sin(), 1.0);
            let pose = Pose::look_at(place, DVec3::ZERO, DVec3::Z).expect("a view");
            let rotation = pose.rotation();
            let pose = Pose::from_world_to_camera(rotation, -(rotation * (factor * place + offset)));
            Frame {
                name: format!("{index}"),
                camera: Camera::new(intrinsics, pose.expect("a pose")).expect("a camera"),
                image: Image::new(4, 4, 3, vec![0; 48]).expect("an image").into(),
                mask: None,
                split: if index % 4 == 3 { Split::Test } else { Split::Train },
            }
        };
        let position = |index: i32| {
            let place = DVec3::new(f64::from(index % 5) - 1.5, f64::from(index % 7) / 7.0, 0.1);
            (factor * place + offset).to_array()
        };
        let cloud = PointCloud { positions: (0..50).map(position).collect(), colors: vec![[1; 3]; 50] };
        Dataset {
            layout: Layout::Blender,
            frames: (0..9).map(frame).collect(),
            points: points.then_some(cloud),
            digest: Digest::of(b"frame"),
            notes: Vec::new(),
        }
    }

    #[test]
    fn neither_unit_nor_place_of_a_dataset_is_seen_in_its_frame() {
        for points in [false, true] {
            let of = |factor: f64, offset: DVec3| {
                let dataset = dataset(points, factor, offset);
                let frame = scene_frame(&dataset);
                (frame, TrainingSet::of(&dataset, frame).expect("near"))
            };
            let (frame, set) = of(1.0, DVec3::ZERO);
            assert!((1.0..10.0).contains(&(frame.scale() * TYPICAL_DISTANCE)), "{frame:?}");
            assert_eq!(set.frames.len(), 7, "those of training");
            assert_eq!(set.points.is_some(), points);
            for (factor, place) in [
                (0.01, DVec3::ZERO),
                (1000.0, DVec3::ZERO),
                (1.0, DVec3::new(5e5, 4e6, 100.0)),
                (300.0, DVec3::new(4e6, -5e5, 5e6)),
            ] {
                let (moved, other) = of(factor, place);
                assert!((moved.scale() / (factor * frame.scale()) - 1.0).abs() < 1e-6, "{factor}");
                let offset = moved.offset() - (place + factor * frame.offset());
                assert!(offset.length() < 1e-6 * moved.scale() + 1e-8, "{offset}");
                for (a, b) in set.frames.iter().zip(&other.frames) {
                    let apart = a.camera.pose.center() - b.camera.pose.center();
                    assert!(apart.length() < 1e-6, "{factor} {place}: {apart}");
                }
                for (a, b) in set.points.iter().zip(&other.points) {
                    let apart = a.positions.as_flattened().iter().zip(b.positions.as_flattened());
                    assert!(apart.clone().all(|(a, b)| (a - b).abs() < 1e-5), "{factor} {place}");
                }
            }
        }
    }

    #[test]
    fn lengths_times_a_power_of_two_have_the_same_numbers_in_the_frame() {
        for points in [false, true] {
            let one = dataset(points, 1.0, DVec3::ZERO);
            let frame = scene_frame(&one);
            let set = TrainingSet::of(&one, frame).expect("near");
            for factor in [0.0625_f64, 4.0, 1024.0] {
                let mut scaled = one.clone();
                // Reading a rotation once more would round it again.
                for (photograph, before) in scaled.frames.iter_mut().zip(&one.frames) {
                    let unit = SceneFrame::new(DVec3::ZERO, factor.recip()).expect("a frame");
                    photograph.camera = unit.camera_from_world(&before.camera);
                }
                if let Some(cloud) = &mut scaled.points {
                    cloud.positions.as_flattened_mut().iter_mut().for_each(|value| *value *= factor);
                }
                let of_scaled = scene_frame(&scaled);
                assert_eq!(
                    (of_scaled.scale(), of_scaled.offset()),
                    (factor * frame.scale(), factor * frame.offset())
                );
                let other = TrainingSet::of(&scaled, of_scaled).expect("near");
                let cameras =
                    |set: &TrainingSet| set.frames.iter().map(|frame| frame.camera).collect::<Vec<_>>();
                assert_eq!(cameras(&other), cameras(&set), "{factor}");
                assert_eq!(other.points, set.points, "{factor}");
            }
        }
    }

    #[test]
    fn points_that_single_precision_cannot_hold_in_the_frame_are_left_out_with_their_colors() {
        let cloud = |colors: Vec<[u8; 3]>| PointCloud {
            positions: vec![[1.0, 2.0, 3.0], [0.0, 2e38, 0.0], [-1.0, 0.0, 1e300], [4.0, 5.0, 6.0]],
            colors,
        };
        let frame = SceneFrame::new(DVec3::ZERO, 0.25).expect("a frame");
        let points = Points::of(&cloud(vec![[1; 3], [2; 3], [3; 3], [4; 3]]), frame);
        assert_eq!(points.positions, [[4.0, 8.0, 12.0], [16.0, 20.0, 24.0]]);
        assert_eq!(points.colors, [[1; 3], [4; 3]]);
        assert_eq!(Points::of(&cloud(Vec::new()), frame).colors, [[0; 3]; 0]);
    }

    #[test]
    fn a_scene_without_a_length_has_the_worlds_unit() {
        let mut dataset = dataset(true, 1.0, DVec3::ZERO);
        let place = dataset.frames[0].camera.pose.center();
        dataset.frames.truncate(1);
        dataset.points = Some(PointCloud { positions: vec![place.to_array(); 3], colors: vec![[0; 3]; 3] });
        let frame = scene_frame(&dataset);
        assert_eq!((frame.scale(), frame.offset()), (1.0, place));
    }
}
