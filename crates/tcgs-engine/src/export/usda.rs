//! Plain Gaussians as USD text: a `ParticleField3DGaussianSplat` of UsdVol (OpenUSD 26.03).
//!
//! Every number is the shortest text that reads as the same float. Sizes and opacities are stored after activation, rotations as unit
//! quaternions w, x, y, z. The coefficients of a Gaussian are next to each other, and the unit is one meter.

use std::fmt::Write as _;

use crate::domain::{GaussianScene, UpAxis, anchors::SceneShapeError, harmonics::functions};

/// Standard deviations by which the stated extent exceeds the positions.
const EXTENT_SIGMAS: f32 = 3.0;

/// The file of a scene whose upward axis, if it was turned, is `up`. USD knows y and z; anything else is stated as y.
///
/// # Errors
/// [`SceneShapeError`] for a scene whose parts do not fit together.
pub fn to_usda(scene: &GaussianScene, up: Option<UpAxis>) -> Result<String, SceneShapeError> {
    scene.check()?;
    let up = if up.is_some_and(|axis| axis.to_string() == "z") { "Z" } else { "Y" };
    let mut text =
        format!("#usda 1.0\n(\n    defaultPrim = \"Scene\"\n    metersPerUnit = 1\n    upAxis = \"{up}\"\n");
    let offset = scene.frame.offset();
    if offset != glam::DVec3::ZERO {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "    customLayerData = {{\n        double3 worldOffset = ({:?}, {:?}, {:?})\n    }}",
            offset.x, offset.y, offset.z
        );
    }
    text.push_str(")\n\ndef ParticleField3DGaussianSplat \"Scene\"\n{\n");
    let scales: Vec<[f32; 3]> = scene.log_scales.iter().map(|log| log.map(f32::exp)).collect();
    let opacity = |logit: &f32| [(1.0 / (1.0 + f64::from(-logit).exp())) as f32];
    array(&mut text, "float3[] extent", extent(scene, &scales).into_iter());
    array(&mut text, "point3f[] positions", scene.means.iter().copied());
    array(&mut text, "quatf[] orientations", scene.quats.iter().map(|quat| unit(*quat)));
    array(&mut text, "float3[] scales", scales.iter().copied());
    array(&mut text, "float[] opacities", scene.opacity_logits.iter().map(opacity));
    let _ = writeln!(text, "    uniform int radiance:sphericalHarmonicsDegree = {}", scene.degree);
    let kept = functions(scene.degree);
    let coefficients = scene.sh.iter().flat_map(|row| row[..kept].iter().copied());
    array(&mut text, "float3[] radiance:sphericalHarmonicsCoefficients", coefficients);
    text.push_str("}\n");
    Ok(text)
}

/// One attribute: tuples of `N` numbers, or plain numbers.
fn array<const N: usize>(text: &mut String, name: &str, rows: impl Iterator<Item = [f32; N]>) {
    text.push_str("    ");
    text.push_str(name);
    text.push_str(" = [");
    for (index, row) in rows.enumerate() {
        text.push_str(if index == 0 { "" } else { ", " });
        text.push_str(if N > 1 { "(" } else { "" });
        for (part, value) in row.iter().enumerate() {
            let comma = if part == 0 { "" } else { ", " };
            let _ = write!(text, "{comma}{value:?}");
        }
        text.push_str(if N > 1 { ")" } else { "" });
    }
    text.push_str("]\n");
}

/// Opposite corners of a box that holds the Gaussians.
fn extent(scene: &GaussianScene, scales: &[[f32; 3]]) -> [[f32; 3]; 2] {
    let mut corners = [[f32::MAX; 3], [f32::MIN; 3]];
    for (mean, scale) in scene.means.iter().zip(scales) {
        let reach = EXTENT_SIGMAS * scale.iter().fold(0.0_f32, |most, value| most.max(*value));
        for axis in 0..3 {
            corners[0][axis] = corners[0][axis].min(mean[axis] - reach);
            corners[1][axis] = corners[1][axis].max(mean[axis] + reach);
        }
    }
    if scene.is_empty() {
        [[0.0; 3]; 2]
    } else {
        corners.map(|corner| corner.map(|value| value.clamp(f32::MIN, f32::MAX)))
    }
}

fn unit(quat: [f32; 4]) -> [f32; 4] {
    let length = quat.iter().map(|part| f64::from(*part).powi(2)).sum::<f64>().sqrt();
    if length > 0.0 { quat.map(|part| (f64::from(part) / length) as f32) } else { [1.0, 0.0, 0.0, 0.0] }
}
