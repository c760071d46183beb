//! The real spherical harmonics of plain Gaussians' colors, with the signs of the 3D Gaussian splatting paper.
//!
//! A color is 0.5 plus the sum of coefficients times these functions of the unit vector from the camera to the mean.

use glam::DVec3;

/// Functions of degrees 0 to 3.
pub const FUNCTIONS: usize = 16;

/// The constant function.
pub const CONSTANT: f64 = 0.282_094_791_773_878_14;

/// Functions of degrees up to `degree`.
#[must_use]
pub fn functions(degree: u8) -> usize {
    (usize::from(degree) + 1).pow(2)
}

/// The degree of a function, from its index.
#[must_use]
pub fn degree_of(function: usize) -> u8 {
    function.isqrt() as u8
}

/// The sixteen functions of degrees 0 to 3 at the unit vector `d`: one, three, five, seven.
#[must_use]
pub fn basis(d: DVec3) -> [f64; FUNCTIONS] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        CONSTANT,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_functions_are_orthonormal_over_the_sphere() {
        // Gauss-Legendre in height, even steps around: exact for products of two functions of degree 3.
        let nodes = [
            (0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
            (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
        ];
        let steps = 8;
        let mut gram = [[0.0; FUNCTIONS]; FUNCTIONS];
        for (height, weight) in nodes.into_iter().flat_map(|(z, w)| [(z, w), (-z, w)]) {
            let radius = f64::sqrt(1.0 - height * height);
            for step in 0..steps {
                let angle = std::f64::consts::TAU * f64::from(step) / f64::from(steps);
                let values = basis(DVec3::new(radius * angle.cos(), radius * angle.sin(), height));
                let area = weight * std::f64::consts::TAU / f64::from(steps);
                for (row, a) in gram.iter_mut().zip(values) {
                    row.iter_mut().zip(values).for_each(|(sum, b)| *sum += area * a * b);
                }
            }
        }
        for (i, row) in gram.iter().enumerate() {
            for (j, sum) in row.iter().enumerate() {
                let expected = f64::from(u8::from(i == j));
                assert!((sum - expected).abs() < 1e-12, "<{i}, {j}> is {sum}");
            }
        }
    }

    #[test]
    fn degrees_follow_one_another() {
        assert_eq!([0, 1, 3, 4, 8, 9, 15].map(degree_of), [0, 1, 1, 2, 2, 3, 3]);
        assert_eq!([0, 1, 2, 3].map(functions), [1, 4, 9, 16]);
    }
}
