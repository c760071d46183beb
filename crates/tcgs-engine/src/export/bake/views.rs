//! The cameras to bake from: those of training, or cameras on a sphere around the scene if those are unknown.

use glam::DVec3;

use crate::domain::{Camera, CameraError, Intrinsics, Pose, evenly_spaced::evenly_spaced};

/// Share of the positions that the sphere's radius is measured by; the rest is background and strays.
const BODY: f64 = 0.9;

/// Radius of the sphere of cameras, in radii of the scene's body.
const DISTANCE: f64 = 3.0;

/// Horizontal field of view in radians, which holds the body with a margin.
const FIELD: f64 = 0.9;

/// Most views that are baked from: more tell a Gaussian of sixteen coefficients little and cost in proportion.
const MAX_VIEWS: usize = 128;

/// Views whose values of all Gaussians are in memory at once.
pub(in crate::export) const VIEWS_AT_ONCE: usize = 16;

/// `count` cameras of `side` x `side` pixels, evenly spread over a sphere around the scene and looking at its middle. The
/// middle is the median of the positions, the radius three times that of nine tenths of them.
///
/// # Errors
/// [`CameraError`] if the positions are so far away that no camera can be placed.
pub fn sphere(positions: &[[f32; 3]], count: usize, side: u32) -> Result<Vec<Camera>, CameraError> {
    let middle = DVec3::from(
        [0, 1, 2]
            .map(|axis| quantile(positions.iter().map(|position| f64::from(position[axis])).collect(), 0.5)),
    );
    let from_middle = |position: &[f32; 3]| DVec3::from(position.map(f64::from)).distance(middle);
    let body = quantile(positions.iter().map(from_middle).collect(), BODY);
    let radius = DISTANCE * if body > 0.0 { body } else { 1.0 };
    let intrinsics = Intrinsics::from_horizontal_fov(FIELD, side, side)?;
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    (0..count)
        .map(|index| {
            let height = 1.0 - (2.0 * index as f64 + 1.0) / count as f64;
            let (sin, cos) = (golden * index as f64).sin_cos();
            let across = (1.0 - height * height).sqrt();
            let direction = DVec3::new(across * cos, across * sin, height);
            let up = if height.abs() > 0.9 { DVec3::X } else { DVec3::Z };
            Camera::new(intrinsics, Pose::look_at(middle + radius * direction, middle, up)?)
        })
        .collect()
}

/// At most 128 of the cameras, evenly along their order.
#[must_use]
pub fn thinned(cameras: &[Camera]) -> Vec<Camera> {
    evenly_spaced(cameras, MAX_VIEWS).copied().collect()
}

fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * share) as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

/// A camera as the question needs it whether it sees a ball.
#[derive(Debug, Clone)]
pub(in crate::export) struct BakeView {
    camera: Camera,
    /// Where it is.
    pub(in crate::export) center: DVec3,
}

impl BakeView {
    pub(in crate::export) fn of(camera: &Camera) -> Self {
        Self { camera: *camera, center: camera.pose.center() }
    }

    /// Whether a ball around a point beyond the near plane may reach the image.
    pub(in crate::export) fn sees(&self, point: DVec3, radius: f64, near: f64) -> bool {
        let Some((x, y, _, scale)) = self.project(point, near) else { return false };
        let (width, height) = self.size();
        let reach = scale * radius;
        x + reach > 0.0 && y + reach > 0.0 && x - reach < width && y - reach < height
    }

    /// Pixel coordinates, depth, and pixels to a world unit there, of a point beyond the near plane.
    pub(in crate::export) fn project(&self, point: DVec3, near: f64) -> Option<(f64, f64, f64, f64)> {
        let Camera { intrinsics: k, pose } = &self.camera;
        let p = pose.rotation() * point + pose.translation();
        let shown = p.z > near;
        shown.then(|| (k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy, p.z, k.fx.max(k.fy) / p.z))
    }

    /// Width and height in pixels.
    pub(in crate::export) fn size(&self) -> (f64, f64) {
        (f64::from(self.camera.intrinsics.width), f64::from(self.camera.intrinsics.height))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sphere_holds_the_scene_in_view_and_strays_do_not_move_it() {
        let mut positions: Vec<[f32; 3]> =
            (0..100).map(|i| [5.0 + (i % 10) as f32 * 0.1, (i / 10) as f32 * 0.1, -3.0]).collect();
        positions.extend([[1e6; 3]; 5]);
        let cameras = sphere(&positions, 20, 64).expect("cameras");
        assert_eq!(cameras.len(), 20);
        for camera in &cameras {
            let distance = camera.pose.center().distance(DVec3::new(5.45, 0.45, -3.0));
            assert!((1.0..4.0).contains(&distance), "{distance}");
            assert!(BakeView::of(camera).sees(DVec3::new(5.0, 0.0, -3.0), 0.0, 0.2));
            assert!(!BakeView::of(camera).sees(camera.pose.center(), 0.1, 0.2));
        }
        let balance: DVec3 = cameras.iter().map(|camera| camera.pose.center()).sum::<DVec3>() / 20.0;
        assert!(balance.distance(DVec3::new(5.45, 0.45, -3.0)) < 0.3, "cameras lean to one side");
    }

    #[test]
    fn a_scene_of_nothing_or_one_point_has_cameras_too() {
        for positions in [&[][..], &[[1.0, 2.0, 3.0]]] {
            assert_eq!(sphere(positions, 3, 8).expect("cameras").len(), 3);
        }
    }

    #[test]
    fn few_cameras_are_all_kept_and_many_are_thinned_evenly() {
        let cameras = sphere(&[[0.0; 3]], 1000, 8).expect("cameras");
        assert_eq!(thinned(&cameras[..7]), cameras[..7]);
        let kept = thinned(&cameras);
        assert_eq!(kept.len(), 128);
        assert_eq!(kept[64], cameras[500]);
        assert!(thinned(&[]).is_empty());
    }
}
