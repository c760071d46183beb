//! Spherical harmonics of degree 3, as the oracles color their Gaussians: max(SH + 0.5, 0).

use glam::DVec3;

/// Rows of numbers.
pub type Rows = Vec<Vec<f64>>;

/// The sixteen basis functions at the unit vector `d`.
pub fn basis(d: DVec3) -> [f64; 16] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        0.282_094_791_773_878_14,
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079_2 * x * y,
        -1.092_548_430_592_079_2 * y * z,
        0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079_2 * x * z,
        0.546_274_215_296_039_6 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * x * y * z,
        -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
    ]
}

fn raw_color(mean: &[f64], sh: &[f64], eye: DVec3) -> DVec3 {
    let direction = (DVec3::new(mean[0], mean[1], mean[2]) - eye).normalize();
    let basis = basis(direction);
    (0..16).map(|k| basis[k] * DVec3::new(sh[3 * k], sh[3 * k + 1], sh[3 * k + 2])).sum::<DVec3>() + 0.5
}

/// Colors of all Gaussians; `sh` has 48 numbers a row.
pub fn sh_colors(means: &Rows, sh: &Rows, eye: DVec3) -> Rows {
    means
        .iter()
        .zip(sh)
        .map(|(mean, sh)| raw_color(mean, sh, eye).max(DVec3::ZERO).to_array().to_vec())
        .collect()
}

/// Gradients by the coefficients (48 a row) and by the means (3 a row) from those by the colors.
pub fn sh_backward(means: &Rows, sh: &Rows, eye: DVec3, d_colors: &Rows) -> (Rows, Rows) {
    let mut d_sh = Vec::new();
    let mut d_means = Vec::new();
    for ((mean, sh), v) in means.iter().zip(sh).zip(d_colors) {
        let raw = raw_color(mean, sh, eye);
        let v =
            DVec3::new(v[0], v[1], v[2]) * DVec3::from(raw.to_array().map(|c| f64::from(u8::from(c > 0.0))));
        let ray = DVec3::new(mean[0], mean[1], mean[2]) - eye;
        let direction = ray.normalize();
        let values = basis(direction);
        d_sh.push((0..48).map(|i| values[i / 3] * v[i % 3]).collect());
        // The basis is cubic, so this combination of two central differences is exact.
        let slopes = |axis: usize, step: f64| {
            let mut offset = DVec3::ZERO;
            offset[axis] = step;
            let (above, below) = (basis(direction + offset), basis(direction - offset));
            (0..16).map(move |k| (above[k] - below[k]) / (2.0 * step))
        };
        let mut d_direction = DVec3::ZERO;
        for axis in 0..3 {
            for (k, (near, far)) in slopes(axis, 0.5).zip(slopes(axis, 1.0)).enumerate() {
                let slope = (4.0 * near - far) / 3.0;
                d_direction[axis] += slope * (0..3).map(|c| sh[3 * k + c] * v[c]).sum::<f64>();
            }
        }
        let d_mean = (d_direction - direction * direction.dot(d_direction)) / ray.length();
        d_means.push(d_mean.to_array().to_vec());
    }
    (d_sh, d_means)
}
