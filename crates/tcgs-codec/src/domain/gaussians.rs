//! A finished scene of either kind: anchors, or plain Gaussians with spherical harmonics.
//!
//! Plain Gaussians hold what the field's `.ply` files hold, before activation; all arrays have the lengths that
//! [`GaussianScene::check`] demands.

use super::{AnchorScene, NearPlane, SceneFrame, anchors::SceneShapeError, harmonics};

/// Spherical-harmonic coefficients a color channel, up to degree 3.
pub const SH_COEFFICIENTS: usize = harmonics::FUNCTIONS;

/// Plain Gaussians as 3D Gaussian splatting trains and stores them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GaussianScene {
    /// Where the scene's coordinates are in the world.
    pub frame: SceneFrame,
    /// Positions in the frame.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithms of the standard deviations along the axes, in the frame's units.
    pub log_scales: Vec<[f32; 3]>,
    /// Rotations w, x, y, z, of any length but zero.
    pub quats: Vec<[f32; 4]>,
    /// Opacities before the logistic.
    pub opacity_logits: Vec<f32>,
    /// Spherical harmonics, red, green and blue of each coefficient; those above `degree` are zero.
    pub sh: Vec<[[f32; 3]; SH_COEFFICIENTS]>,
    /// Highest degree in use, 0 to 3.
    pub degree: u8,
    /// Where views begin, as in training.
    pub near: NearPlane,
}

impl GaussianScene {
    /// Number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there is no Gaussian.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// The scene with those Gaussians alone, in this order.
    #[must_use]
    pub fn with_only(&self, indices: &[usize]) -> Self {
        fn chosen<T: Copy>(values: &[T], indices: &[usize]) -> Vec<T> {
            indices.iter().map(|index| values[*index]).collect()
        }
        Self {
            means: chosen(&self.means, indices),
            log_scales: chosen(&self.log_scales, indices),
            quats: chosen(&self.quats, indices),
            opacity_logits: chosen(&self.opacity_logits, indices),
            sh: chosen(&self.sh, indices),
            ..*self
        }
    }

    /// Checks lengths, degree and finiteness.
    ///
    /// # Errors
    /// [`SceneShapeError`] naming the first part that does not fit.
    pub fn check(&self) -> Result<(), SceneShapeError> {
        let lengths = [
            ("log-scales", self.log_scales.len()),
            ("quaternions", self.quats.len()),
            ("opacities", self.opacity_logits.len()),
            ("spherical harmonics", self.sh.len()),
        ];
        for (part, len) in lengths {
            if len != self.len() {
                return Err(SceneShapeError(format!("{len} {part} for {} Gaussians", self.len())));
            }
        }
        if self.degree > 3 {
            return Err(SceneShapeError(format!("spherical harmonics of degree {}", self.degree)));
        }
        let parts = [
            ("mean", self.means.as_flattened()),
            ("log-scale", self.log_scales.as_flattened()),
            ("quaternion", self.quats.as_flattened()),
            ("opacity", &self.opacity_logits[..]),
            ("spherical harmonic", self.sh.as_flattened().as_flattened()),
        ];
        match parts.iter().find(|(_, values)| values.iter().any(|value| !value.is_finite())) {
            Some((part, _)) => Err(SceneShapeError(format!("a {part} is not finite"))),
            None => Ok(()),
        }
    }
}

/// A finished scene.
#[derive(Debug, Clone, PartialEq)]
pub enum Scene {
    /// Anchors and the networks that turn them into Gaussians.
    Anchors(AnchorScene),
    /// Plain Gaussians.
    Gaussians(GaussianScene),
}

impl Scene {
    /// Where views begin.
    #[must_use]
    pub fn near(&self) -> NearPlane {
        match self {
            Scene::Anchors(scene) => scene.near,
            Scene::Gaussians(scene) => scene.near,
        }
    }

    /// The same scene in another place: with its coordinates, as they are, in `frame`.
    #[must_use]
    pub fn in_frame(self, frame: SceneFrame) -> Self {
        match self {
            Scene::Anchors(scene) => Scene::Anchors(AnchorScene { frame, ..scene }),
            Scene::Gaussians(scene) => Scene::Gaussians(GaussianScene { frame, ..scene }),
        }
    }

    /// Where its coordinates are in the world.
    #[must_use]
    pub fn frame(&self) -> SceneFrame {
        match self {
            Scene::Anchors(scene) => scene.frame,
            Scene::Gaussians(scene) => scene.frame,
        }
    }

    /// Anchors; zero in a scene of plain Gaussians.
    #[must_use]
    pub fn anchors(&self) -> usize {
        match self {
            Scene::Anchors(scene) => scene.len(),
            Scene::Gaussians(_) => 0,
        }
    }

    /// Gaussians, or offsets that make one.
    #[must_use]
    pub fn gaussians(&self) -> usize {
        match self {
            Scene::Anchors(scene) => scene.gaussians(),
            Scene::Gaussians(scene) => scene.len(),
        }
    }

    /// The anchors, if it is a scene of anchors.
    #[must_use]
    pub fn as_anchors(&self) -> Option<&AnchorScene> {
        match self {
            Scene::Anchors(scene) => Some(scene),
            Scene::Gaussians(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> GaussianScene {
        GaussianScene {
            frame: SceneFrame::WORLD,
            means: vec![[0.0; 3]; 2],
            log_scales: vec![[0.0; 3]; 2],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.0; 2],
            sh: vec![[[0.0; 3]; SH_COEFFICIENTS]; 2],
            degree: 3,
            near: NearPlane::default(),
        }
    }

    #[test]
    fn what_does_not_fit_is_named() {
        assert_eq!(scene().check(), Ok(()));
        let error = |change: fn(&mut GaussianScene)| {
            let mut changed = scene();
            change(&mut changed);
            changed.check().expect_err("a fault").to_string()
        };
        assert!(error(|s| s.quats.truncate(1)).contains("1 quaternions for 2 Gaussians"));
        assert!(error(|s| s.degree = 4).contains("degree 4"));
        assert!(error(|s| s.sh[1][15][2] = f32::NAN).contains("spherical harmonic is not finite"));
        assert!(error(|s| s.opacity_logits[0] = f32::INFINITY).contains("opacity is not finite"));
    }
}
