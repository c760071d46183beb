//! Camera models beyond the polynomial of [`super::distortion`]: where on the image plane a direction of view is seen.
//!
//! Each follows its published definition in the form and parameter order of COLMAP: OpenCV's rational model; the FOV model (Devernay and
//! Faugeras 2001); equidistant fisheyes with a polynomial of the angle (Kannala and Brandt 2006), alone, with thin prisms, or with tangential
//! terms and thin prisms as of Project Aria; the division model (Fitzgibbon 2001); the enhanced unified model (Khomutenko et al. 2016).

/// Where the series of a quotient replaces it.
const SMALL: f64 = 1e-9;

/// A camera model with its parameters, focal lengths and principal point aside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Projection {
    /// A quotient of polynomials of r², k1 to k3 over k4 to k6, and tangential terms.
    Rational { radial: [f64; 6], tangential: [f64; 2] },
    /// A wide lens by its field of view, in radians.
    Fov { omega: f64 },
    /// The angle from the axis times a polynomial of its square.
    Fisheye { radial: [f64; 4] },
    /// An equidistant fisheye whose image is distorted by a polynomial and thin prisms.
    ThinPrismFisheye { radial: [f64; 4], tangential: [f64; 2], prism: [f64; 2] },
    /// A fisheye with a polynomial of the angle, then tangential terms and thin prisms.
    RadTanThinPrismFisheye { radial: [f64; 6], tangential: [f64; 2], prism: [f64; 4] },
    /// An undistorted radius is the distorted one over 1 + k times its square.
    Division { k: f64 },
    /// Onto an ellipsoid, then from a point on the axis.
    EnhancedUnified { alpha: f64, beta: f64 },
}

impl Projection {
    /// Whether every parameter is finite.
    pub(super) fn is_finite(&self) -> bool {
        let all = |parts: &[&[f64]]| parts.iter().copied().flatten().all(|value| value.is_finite());
        match self {
            Self::Rational { radial, tangential } => all(&[radial, tangential]),
            Self::Fov { omega } => omega.is_finite(),
            Self::Fisheye { radial } => all(&[radial]),
            Self::ThinPrismFisheye { radial, tangential, prism } => all(&[radial, tangential, prism]),
            Self::RadTanThinPrismFisheye { radial, tangential, prism } => all(&[radial, tangential, prism]),
            Self::Division { k } => k.is_finite(),
            Self::EnhancedUnified { alpha, beta } => alpha.is_finite() && beta.is_finite(),
        }
    }

    /// The image position, before focal lengths and principal point, of a point on the plane at depth 1; not finite if there is none.
    pub(super) fn project(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let r2 = x * x + y * y;
        let scaled = |factor: f64| [x * factor, y * factor];
        match self {
            Self::Rational { radial, tangential } => {
                let [k1, k2, k3, k4, k5, k6] = *radial;
                let factor = polynomial(r2, &[k1, k2, k3]) / polynomial(r2, &[k4, k5, k6]);
                let ([x, y], [dx, dy]) = (scaled(factor), tangent([x, y], *tangential));
                [x + dx, y + dy]
            }
            Self::Fov { omega } => {
                let (r, slope) = (r2.sqrt(), 2.0 * (omega / 2.0).tan());
                if omega.abs() < SMALL {
                    return [x, y];
                }
                scaled(if r < SMALL { slope / omega } else { (r * slope).atan() / (r * omega) })
            }
            Self::Fisheye { radial } => {
                let (angle, factor) = angle(r2);
                scaled(factor * polynomial(angle * angle, radial))
            }
            Self::ThinPrismFisheye { radial, tangential, prism } => {
                let [x, y] = scaled(angle(r2).1);
                let r2 = x * x + y * y;
                let (factor, [dx, dy]) = (polynomial(r2, radial), tangent([x, y], *tangential));
                [x * factor + dx + prism[0] * r2, y * factor + dy + prism[1] * r2]
            }
            Self::RadTanThinPrismFisheye { radial, tangential: [p0, p1], prism: [s0, s1, s2, s3] } => {
                let (angle, factor) = angle(r2);
                let [x, y] = scaled(factor * polynomial(angle * angle, radial));
                let r2 = x * x + y * y;
                let [dx, dy] = tangent([x, y], [*p1, *p0]);
                [x + dx + r2 * (s0 + r2 * s1), y + dy + r2 * (s2 + r2 * s3)]
            }
            Self::Division { k } => scaled(2.0 / (1.0 + (1.0 - 4.0 * k * r2).sqrt())),
            Self::EnhancedUnified { alpha, beta } => {
                scaled(1.0 / (alpha * (beta * r2 + 1.0).sqrt() + 1.0 - alpha))
            }
        }
    }
}

/// The angle from the axis of a point at the square of this radius on the plane at depth 1, and the angle over the radius.
fn angle(r2: f64) -> (f64, f64) {
    let r = r2.sqrt();
    let angle = r.atan();
    (angle, if r < SMALL { 1.0 } else { angle / r })
}

/// 1 + k1 s + k2 s² + ...
fn polynomial(s: f64, coefficients: &[f64]) -> f64 {
    1.0 + s * coefficients.iter().rev().fold(0.0, |sum, k| sum * s + k)
}

/// Tangential terms p1 and p2 in the convention of OpenCV.
fn tangent([x, y]: [f64; 2], [p1, p2]: [f64; 2]) -> [f64; 2] {
    let r2 = x * x + y * y;
    [2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y]
}
