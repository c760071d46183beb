//! The views that a scene is refined on: those of the given cameras, and views from between neighbors.

use std::f64::consts::FRAC_1_SQRT_2;

use glam::{DMat3, DQuat};
use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_pcg::Pcg64;

use crate::domain::{Camera, Pose};

/// Nearest cameras that count as a camera's neighbors.
const NEIGHBORS: usize = 4;

/// Least cosine of the angle between the directions in which neighbors look.
const LEAST_COSINE: f64 = FRAC_1_SQRT_2;

/// Chooses a view for each step, by a seed.
pub(super) struct Poses {
    cameras: Vec<Camera>,
    neighbors: Vec<Vec<usize>>,
    order: Vec<usize>,
    rng: Pcg64,
    is_between: bool,
}

impl Poses {
    /// At least one camera.
    pub(super) fn new(cameras: Vec<Camera>, seed: u64) -> Self {
        let neighbors = (0..cameras.len()).map(|index| neighbors(&cameras, index)).collect();
        Self { cameras, neighbors, order: Vec::new(), rng: Pcg64::seed_from_u64(seed), is_between: true }
    }

    /// The next view: every camera in random order, alternately at its own place and on the way to a neighbor.
    pub(super) fn next(&mut self) -> Option<Camera> {
        if self.order.is_empty() {
            self.order.extend(0..self.cameras.len());
            self.order.shuffle(&mut self.rng);
        }
        let index = self.order.pop()?;
        self.is_between = !self.is_between;
        let (camera, neighbors) = (self.cameras[index], &self.neighbors[index]);
        if !self.is_between || neighbors.is_empty() {
            return Some(camera);
        }
        let neighbor = self.cameras[neighbors[self.rng.random_range(0..neighbors.len())]];
        Some(between(&camera, &neighbor, self.rng.random_range(0.0..1.0)).unwrap_or(camera))
    }
}

fn neighbors(cameras: &[Camera], index: usize) -> Vec<usize> {
    let (center, forward) = (cameras[index].pose.center(), forward(&cameras[index]));
    let mut others: Vec<(f64, usize)> = (0..cameras.len())
        .filter(|other| *other != index && forward.dot(self::forward(&cameras[*other])) >= LEAST_COSINE)
        .map(|other| (cameras[other].pose.center().distance_squared(center), other))
        .collect();
    others.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    others.into_iter().take(NEIGHBORS).map(|(_, other)| other).collect()
}

fn forward(camera: &Camera) -> glam::DVec3 {
    camera.pose.rotation().row(2)
}

/// The camera moved and turned by a share of the way to another one.
fn between(camera: &Camera, other: &Camera, share: f64) -> Option<Camera> {
    let [from, to] = [camera, other].map(|camera| DQuat::from_mat3(&camera.pose.rotation()));
    let rotation = DMat3::from_quat(from.slerp(to, share));
    let center = camera.pose.center().lerp(other.pose.center(), share);
    let pose = Pose::from_world_to_camera(rotation, -(rotation * center)).ok()?;
    Some(Camera { pose, ..*camera })
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::domain::Intrinsics;

    fn camera(x: f64, target: f64) -> Camera {
        let intrinsics = Intrinsics::from_horizontal_fov(0.8, 40, 32).expect("intrinsics");
        let pose =
            Pose::look_at(DVec3::new(x, 0.0, 0.0), DVec3::new(x, target, 0.0), DVec3::Z).expect("a view");
        Camera::new(intrinsics, pose).expect("a camera")
    }

    #[test]
    fn views_are_those_of_cameras_and_from_between_neighbors_that_look_the_same_way() {
        // The last one looks back.
        let cameras = [camera(0.0, 1.0), camera(1.0, 1.0), camera(0.5, -1.0)].to_vec();
        let mut poses = Poses::new(cameras.clone(), 1);
        let views: Vec<Camera> = (0..60).filter_map(|_| poses.next()).collect();
        let own = views.iter().filter(|view| cameras.contains(view)).count();
        assert!((30..60).contains(&own), "{own}");
        for view in &views {
            let center = view.pose.center();
            assert!((-1e-9..=1.0 + 1e-9).contains(&center.x), "{center}");
            assert!(forward(view).y.abs() > 0.999, "nothing lies between those that look in two directions");
        }
        let mut again = Poses::new(cameras, 1);
        assert!(views.iter().all(|view| again.next().as_ref() == Some(view)), "another choice");
        assert!(Poses::new(Vec::new(), 1).next().is_none());
        assert_eq!(Poses::new(vec![camera(0.0, 1.0)], 1).next(), Some(camera(0.0, 1.0)));
    }
}
