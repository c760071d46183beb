//! The part of the world that a crop keeps, once the training cameras are known.

use glam::DVec3;

use super::{Camera, Crop, Dataset, Split};

/// A part of the world.
#[derive(Debug, Clone, PartialEq)]
pub enum CropRegion {
    /// Between two corners.
    Box {
        /// The least corner.
        least: DVec3,
        /// The greatest corner.
        greatest: DVec3,
    },
    /// What a number of cameras have in view.
    Shared {
        /// The cameras.
        cameras: Vec<Camera>,
        /// How many of them must see a point.
        needed: usize,
    },
}

impl CropRegion {
    /// The region of a crop of a scene with these training cameras; `None` if everything is kept.
    #[must_use]
    pub fn new(crop: &Crop, cameras: impl FnOnce() -> Vec<Camera>) -> Option<Self> {
        match *crop {
            Crop::None => None,
            Crop::Cameras => {
                let cameras = cameras();
                let needed = cameras.len().div_ceil(2).max(1);
                Some(Self::Shared { cameras, needed })
            }
            Crop::Box(least, greatest) => Some(Self::Box { least: least.into(), greatest: greatest.into() }),
        }
    }

    /// As [`CropRegion::new`], with the training cameras of a dataset.
    #[must_use]
    pub fn of_dataset(crop: &Crop, dataset: &Dataset) -> Option<Self> {
        Self::new(crop, || dataset.split(Split::Train).map(|frame| frame.camera).collect())
    }

    /// Whether a point of the world lies in it.
    #[must_use]
    pub fn contains(&self, point: DVec3) -> bool {
        match self {
            Self::Box { least, greatest } => point.cmpge(*least).all() && point.cmple(*greatest).all(),
            Self::Shared { cameras, needed } => {
                cameras.iter().filter(|camera| sees(camera, point)).take(*needed).count() == *needed
            }
        }
    }
}

/// Whether a point is within a camera's picture.
fn sees(camera: &Camera, point: DVec3) -> bool {
    camera.project(point).is_some_and(|(pixel, _)| {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        (0.0..=f64::from(width)).contains(&pixel.x) && (0.0..=f64::from(height)).contains(&pixel.y)
    })
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::domain::{Intrinsics, Pose};

    fn camera(position: DVec3, target: DVec3) -> Camera {
        let intrinsics = Intrinsics::from_horizontal_fov(0.7, 200, 200).expect("intrinsics");
        Camera::new(intrinsics, Pose::look_at(position, target, DVec3::Z).expect("a view")).expect("a camera")
    }

    fn by(cameras: &[Camera]) -> CropRegion {
        CropRegion::new(&Crop::Cameras, || cameras.to_vec()).expect("a region")
    }

    #[test]
    fn cameras_around_an_object_keep_it_and_not_what_stands_behind_it() {
        let around = |index: u32| {
            let angle = TAU * f64::from(index) / 24.0;
            camera(DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 1.0), DVec3::ZERO)
        };
        let region = by(&(0..24).map(around).collect::<Vec<_>>());
        for kept in [DVec3::ZERO, DVec3::new(1.0, 0.0, 0.3), DVec3::new(-0.7, 0.7, -0.5)] {
            assert!(region.contains(kept), "{kept}");
        }
        for removed in [DVec3::X * 4.0, DVec3::new(3.0, 0.0, 0.7), DVec3::new(-9.0, 0.0, 0.0), DVec3::Z * 6.0]
        {
            assert!(!region.contains(removed), "{removed}");
        }
    }

    #[test]
    fn cameras_side_by_side_keep_what_most_of_them_show_however_far_it_is() {
        let beside = |index: u32| {
            let position = DVec3::new(f64::from(index) * 0.2 - 1.0, 0.0, 0.0);
            camera(position, position + DVec3::Y)
        };
        let region = by(&(0..11).map(beside).collect::<Vec<_>>());
        for kept in [DVec3::new(0.0, 5.0, 0.0), DVec3::new(1.0, 6.0, -1.0), DVec3::new(0.0, 900.0, 50.0)] {
            assert!(region.contains(kept), "{kept}");
        }
        // Right before one camera, beside the row, and behind it.
        for removed in
            [DVec3::new(1.0, 0.3, 0.0), DVec3::new(4.0, 3.0, 0.0), DVec3::new(0.0, -5.0, 0.0), DVec3::ZERO]
        {
            assert!(!region.contains(removed), "{removed}");
        }
    }

    #[test]
    fn a_box_has_its_faces_and_no_region_is_everything() {
        let region = CropRegion::new(&Crop::Box([0.0; 3], [1.0, 2.0, 3.0]), Vec::new).expect("a region");
        assert!(region.contains(DVec3::ZERO) && region.contains(DVec3::new(1.0, 2.0, 3.0)));
        assert!(!region.contains(DVec3::new(0.5, 2.1, 1.0)) && !region.contains(DVec3::NAN));
        assert_eq!(CropRegion::new(&Crop::None, Vec::new), None);
    }
}
