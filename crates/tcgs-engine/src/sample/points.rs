//! A point cloud as structure from motion would find it: surface points that several cameras see, slightly displaced, with the colors
//! seen there.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{
    scene::{Scene, Solid},
    shape::SampleShape,
};
use crate::domain::{Camera, PointCloud};

/// Cameras that must see a point, as a track of that length would need.
const MIN_CAMERAS: usize = 3;

/// Half the width of the jitter on each axis, in world units.
const JITTER: f64 = 0.004;

/// Draws `count` points (fewer only if the cameras see almost nothing).
pub(super) fn cloud(scene: &Scene, cameras: &[Camera], count: usize, seed: u64) -> PointCloud {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let total: f64 = scene.solids.iter().map(|solid| solid.points).sum();
    let mut cloud = PointCloud::default();
    for _ in 0..count * 50 {
        if cloud.positions.len() == count {
            break;
        }
        let solid = pick(&scene.solids, rng.random::<f64>() * total);
        let point = solid.shape.surface_point(&mut rng);
        let jitter = DVec3::from_array(std::array::from_fn(|_| JITTER * (2.0 * rng.random::<f64>() - 1.0)));
        let off_surface = point + solid.shape.normal(point) * 1e-3;
        let seen = cameras
            .iter()
            .filter(|camera| {
                is_in_image(camera, point) && scene.is_visible(off_surface, camera.pose.center())
            })
            .take(MIN_CAMERAS)
            .count();
        if seen < MIN_CAMERAS || (point.z < 0.0 && !matches!(solid.shape, SampleShape::Ground { .. })) {
            continue;
        }
        // As the file will have it.
        cloud.positions.push((point + jitter).as_vec3().as_dvec3().to_array());
        cloud.colors.push(scene.matt_color(solid, point));
    }
    cloud
}

fn pick(solids: &[Solid], mut at: f64) -> &Solid {
    for solid in solids {
        if at < solid.points {
            return solid;
        }
        at -= solid.points;
    }
    &solids[solids.len() - 1]
}

fn is_in_image(camera: &Camera, point: DVec3) -> bool {
    let (width, height) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
    camera.project(point).is_some_and(|(at, _)| (0.0..width).contains(&at.x) && (0.0..height).contains(&at.y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::{Settings, views};

    #[test]
    fn the_cloud_is_seeded_and_its_colors_are_what_the_cameras_see() {
        let scene = Scene::still_life();
        let cameras = views::cameras(&Settings::square(96));
        let cloud = cloud_of(&scene, &cameras, 7);
        assert_eq!(cloud, cloud_of(&scene, &cameras, 7));
        assert_ne!(cloud, cloud_of(&scene, &cameras, 8));
        assert_eq!(cloud.positions.len(), 600);

        let camera = &cameras[9];
        let image = scene.render(camera);
        let mut differences: Vec<u8> = Vec::new();
        for (position, color) in cloud.positions.iter().zip(&cloud.colors) {
            let point = DVec3::from_array(*position);
            if !is_in_image(camera, point) || !scene.is_visible(point + DVec3::Z * 0.01, camera.pose.center())
            {
                continue;
            }
            let (at, _) = camera.project(point).expect("in the image");
            let first = (at.y as usize * 96 + at.x as usize) * 3;
            differences
                .extend((0..3).map(|channel| image.samples()[first + channel].abs_diff(color[channel])));
        }
        assert!(differences.len() > 300, "only {} samples are in view", differences.len());
        differences.sort_unstable();
        let median = differences[differences.len() / 2];
        assert!(median < 12, "half of the cloud's colors are {median} or more away from the image's");
    }

    fn cloud_of(scene: &Scene, cameras: &[Camera], seed: u64) -> PointCloud {
        cloud(scene, cameras, 600, seed)
    }
}
