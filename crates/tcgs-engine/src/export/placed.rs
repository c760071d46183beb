//! Plain Gaussians under a rotation and a factor of lengths.
//!
//! Rotations turn spherical harmonics within each degree: `Y_i(R⁻¹ d) = Σ_j D_ij Y_j(d)` for every direction `d`, with
//! `D_ij = ∫ Y_i(R⁻¹ d) Y_j(d)` over the sphere, since the functions are orthonormal.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};

use crate::domain::{
    GaussianScene, NearPlane, SceneFrame, Similarity,
    gaussians::SH_COEFFICIENTS,
    harmonics::{basis, degree_of},
};

/// The scene, in world units, turned and scaled.
#[must_use]
pub fn placed(scene: &GaussianScene, similarity: &Similarity) -> GaussianScene {
    if *similarity == Similarity::NONE {
        return scene.clone();
    }
    let turned = RotatedHarmonics::new(similarity.rotation());
    let longer = similarity.scale().ln();
    let mean = |mean: &[f32; 3]| similarity.point(wide(*mean)).as_vec3().to_array();
    let near = NearPlane::new((f64::from(scene.near.depth()) * similarity.scale()) as f32);
    let offset = similarity.point(scene.frame.offset());
    GaussianScene {
        frame: SceneFrame::new(offset, scene.frame.scale()).unwrap_or_default(),
        means: scene.means.iter().map(mean).collect(),
        log_scales: scene
            .log_scales
            .iter()
            .map(|log| log.map(|log| (f64::from(log) + longer) as f32))
            .collect(),
        quats: scene.quats.iter().map(|quat| rotated(similarity.rotation(), *quat)).collect(),
        sh: scene.sh.iter().map(|row| turned.of(row)).collect(),
        near: near.unwrap_or(scene.near),
        ..scene.clone()
    }
}

fn wide(point: [f32; 3]) -> DVec3 {
    DVec3::from(point.map(f64::from))
}

/// A Gaussian's rotation w, x, y, z after another one.
fn rotated(rotation: DQuat, quat: [f32; 4]) -> [f32; 4] {
    let [w, x, y, z] = quat.map(f64::from);
    let DQuat { x, y, z, w } = rotation * DQuat::from_xyzw(x, y, z, w);
    [w, x, y, z].map(|part| part as f32)
}

/// How coefficients change with a rotation.
struct RotatedHarmonics([[f64; SH_COEFFICIENTS]; SH_COEFFICIENTS]);

impl RotatedHarmonics {
    fn new(rotation: DQuat) -> Self {
        let back = rotation.conjugate();
        let mut matrix = [[0.0; SH_COEFFICIENTS]; SH_COEFFICIENTS];
        for (direction, weight) in quadrature() {
            let (before, after) = (basis(back * direction), basis(direction));
            for (i, row) in matrix.iter_mut().enumerate() {
                for (j, sum) in row.iter_mut().enumerate() {
                    if degree_of(i) == degree_of(j) {
                        *sum += weight * before[i] * after[j];
                    }
                }
            }
        }
        Self(matrix)
    }

    fn of(&self, row: &[[f32; 3]; SH_COEFFICIENTS]) -> [[f32; 3]; SH_COEFFICIENTS] {
        let mut sums = [[0.0; 3]; SH_COEFFICIENTS];
        for (coefficient, factors) in row.iter().zip(&self.0) {
            for (sum, factor) in sums.iter_mut().zip(factors) {
                for (sum, value) in sum.iter_mut().zip(coefficient) {
                    *sum += factor * f64::from(*value);
                }
            }
        }
        sums.map(|sum| sum.map(|value| value as f32))
    }
}

/// Directions with weights whose sum is the integral over the sphere of products of two functions of up to degree 3: Gauss-Legendre in
/// height, even steps around.
fn quadrature() -> impl Iterator<Item = (DVec3, f64)> {
    const NODES: [(f64, f64); 2] = [
        (0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
        (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
    ];
    const STEPS: u32 = 8;
    let heights = NODES.into_iter().flat_map(|(height, weight)| [(height, weight), (-height, weight)]);
    heights.flat_map(|(height, weight)| {
        let radius = f64::sqrt(1.0 - height * height);
        (0..STEPS).map(move |step| {
            let (sin, cos) = (TAU * f64::from(step) / f64::from(STEPS)).sin_cos();
            (DVec3::new(radius * cos, radius * sin, height), weight * TAU / f64::from(STEPS))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Placement, UpAxis};

    fn rotation() -> DQuat {
        DQuat::from_axis_angle(DVec3::new(1.0, -2.0, 0.5).normalize(), 1.1)
    }

    #[test]
    fn colors_follow_the_rotation() {
        let row: [[f32; 3]; SH_COEFFICIENTS] =
            std::array::from_fn(|i| [0.3 - i as f32 / 20.0, (i as f32).sin(), 0.1]);
        let turned = RotatedHarmonics::new(rotation()).of(&row);
        let color = |row: &[[f32; 3]; SH_COEFFICIENTS], d: DVec3| {
            let mut sum = [0.0; 3];
            for (coefficient, value) in row.iter().zip(basis(d)) {
                (0..3).for_each(|channel| sum[channel] += f64::from(coefficient[channel]) * value);
            }
            sum
        };
        for direction in [DVec3::X, DVec3::new(0.2, -0.7, 0.4), DVec3::new(-3.0, 1.0, 2.0)] {
            let direction = direction.normalize();
            let (before, after) = (color(&row, direction), color(&turned, rotation() * direction));
            assert!(before.iter().zip(after).all(|(a, b)| (a - b).abs() < 1e-5), "{before:?} {after:?}");
        }
        assert_eq!(turned[0], row[0], "what all directions share stays");
    }

    #[test]
    fn covariances_follow_the_rotation_and_the_factor() {
        let scene = GaussianScene {
            means: vec![[1.0, 2.0, 3.0]],
            log_scales: vec![[-1.0, -2.0, -3.0]],
            quats: vec![[0.8, -0.4, 0.2, 1.4]],
            opacity_logits: vec![0.5],
            sh: vec![[[0.25; 3]; SH_COEFFICIENTS]],
            degree: 3,
            ..GaussianScene::default()
        };
        let covariance = |scene: &GaussianScene| {
            let [w, x, y, z] = scene.quats[0].map(f64::from);
            let turn = glam::DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
            let deviations = DVec3::from(scene.log_scales[0].map(|log| f64::from(log).exp()));
            let half = turn * glam::DMat3::from_diagonal(deviations);
            half * half.transpose()
        };
        let placement = Placement { up: None, scale: 3.0 };
        let scaled = placed(&scene, &placement.similarity(&[]).expect("a factor"));
        assert!((covariance(&scaled) - 9.0 * covariance(&scene)).abs_diff_eq(glam::DMat3::ZERO, 1e-5));
        assert_eq!(scaled.means, [[3.0, 6.0, 9.0]]);
        assert!((scaled.near.depth() - 3.0 * scene.near.depth()).abs() < 1e-6);
        let turn = glam::DMat3::from_quat(rotation());
        let [w, x, y, z] = rotated(rotation(), scene.quats[0]);
        let turned = GaussianScene { quats: vec![[w, x, y, z]], ..scene.clone() };
        let expected = turn * covariance(&scene) * turn.transpose();
        assert!((covariance(&turned) - expected).abs_diff_eq(glam::DMat3::ZERO, 1e-5));
        assert_eq!(UpAxis::NAMES, ["x", "y", "z", "-x", "-y", "-z"]);
    }
}
