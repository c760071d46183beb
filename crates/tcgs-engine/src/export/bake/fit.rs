//! Fits spherical harmonics to colors seen from given directions: weighted least squares in f64 by the normal equations of one Gaussian,
//! which its three channels share.
//!
//! A Tikhonov term on the roughness of the color, not on its mean, regularizes directions without a view: a Gaussian that was seen from
//! one side only keeps its color on the other.

use crate::domain::{gaussians::SH_COEFFICIENTS, harmonics};

/// A pivot this much smaller than the diagonal's first says that the directions do not tell the functions apart.
const SINGULAR: f64 = 1e-13;

/// Coefficients, red, green and blue of each.
pub type Coefficients = [[f64; 3]; SH_COEFFICIENTS];

/// The weighted sums that a fit is solved from.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalEquations {
    functions: usize,
    /// Sums of weight times a product of two functions, the lower triangle.
    gram: [[f64; SH_COEFFICIENTS]; SH_COEFFICIENTS],
    /// Sums of weight times function times color.
    moments: Coefficients,
    weight: f64,
}

impl NormalEquations {
    /// Empty sums, for functions of degree 0 to `degree`, which is at most 3.
    #[must_use]
    pub fn new(degree: u8) -> Self {
        Self {
            functions: harmonics::functions(degree).min(SH_COEFFICIENTS),
            gram: [[0.0; SH_COEFFICIENTS]; SH_COEFFICIENTS],
            moments: [[0.0; 3]; SH_COEFFICIENTS],
            weight: 0.0,
        }
    }

    /// Adds a sample: the functions' values at its direction, its color, and how much it counts.
    pub fn add(&mut self, basis: &[f64; SH_COEFFICIENTS], color: [f64; 3], weight: f64) {
        self.weight += weight;
        for row in 0..self.functions {
            let weighted = weight * basis[row];
            for (sum, value) in self.gram[row][..=row].iter_mut().zip(basis) {
                *sum += weighted * value;
            }
            for (sum, value) in self.moments[row].iter_mut().zip(color) {
                *sum += weighted * value;
            }
        }
    }

    /// The coefficients that minimize the weighted squared error plus `ridge` times the weight times the squared norm of
    /// the color's Laplacian on the sphere (`l (l + 1)` times each coefficient of degree l). Functions that the samples
    /// do not determine get zero.
    #[must_use]
    pub fn solve(&self, ridge: f64) -> Coefficients {
        let n = self.functions;
        let mut factor = self.gram;
        for (function, row) in factor.iter_mut().enumerate().take(n) {
            let degree = f64::from(harmonics::degree_of(function));
            row[function] += ridge * self.weight * (degree * (degree + 1.0)).powi(2);
        }
        // L D Lᵀ in place; a vanishing pivot leaves its function out.
        let smallest = SINGULAR * factor[0][0].max(f64::MIN_POSITIVE);
        let mut pivots = [0.0; SH_COEFFICIENTS];
        for row in 0..n {
            for column in 0..row {
                let known: f64 = (0..column).map(|k| factor[row][k] * pivots[k] * factor[column][k]).sum();
                let left = factor[row][column] - known;
                factor[row][column] = if pivots[column] > 0.0 { left / pivots[column] } else { 0.0 };
            }
            let known: f64 = (0..row).map(|k| factor[row][k].powi(2) * pivots[k]).sum();
            let pivot = factor[row][row] - known;
            pivots[row] = if pivot > smallest { pivot } else { 0.0 };
        }
        let mut solution = self.moments;
        for channel in 0..3 {
            for (row, factors) in factor.iter().enumerate().take(n) {
                let known: f64 =
                    factors[..row].iter().zip(&solution).map(|(factor, known)| factor * known[channel]).sum();
                solution[row][channel] -= known;
            }
            for (value, pivot) in solution.iter_mut().zip(pivots).take(n) {
                value[channel] = if pivot > 0.0 { value[channel] / pivot } else { 0.0 };
            }
            for row in (0..n).rev() {
                let known: f64 = (row + 1..n).map(|k| factor[k][row] * solution[k][channel]).sum();
                if pivots[row] > 0.0 {
                    solution[row][channel] -= known;
                }
            }
        }
        solution
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use rand::{RngExt, SeedableRng};

    use super::*;

    fn directions(count: usize, seed: u64) -> Vec<DVec3> {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        (0..count)
            .map(|_| DVec3::from([(); 3].map(|()| rng.random_range(-1.0..1.0))).normalize_or(DVec3::Z))
            .collect()
    }

    fn color(coefficients: &Coefficients, direction: DVec3) -> [f64; 3] {
        let basis = harmonics::basis(direction);
        [0, 1, 2].map(|channel| basis.iter().zip(coefficients).map(|(b, c)| b * c[channel]).sum())
    }

    fn fitted(degree: u8, ridge: f64, samples: &[(DVec3, [f64; 3], f64)]) -> Coefficients {
        let mut normal = NormalEquations::new(degree);
        for (direction, color, weight) in samples {
            normal.add(&harmonics::basis(*direction), *color, *weight);
        }
        normal.solve(ridge)
    }

    #[test]
    fn colors_of_few_bands_are_found_again() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
        for degree in 0..=3 {
            let mut truth = [[0.0; 3]; SH_COEFFICIENTS];
            for row in &mut truth[..harmonics::functions(degree)] {
                *row = [(); 3].map(|()| rng.random_range(-1.0..1.0));
            }
            let samples: Vec<_> = directions(40, u64::from(degree))
                .into_iter()
                .map(|d| (d, color(&truth, d), rng.random_range(0.1..1.0)))
                .collect();
            let found = fitted(degree, 0.0, &samples);
            for (found, truth) in found.as_flattened().iter().zip(truth.as_flattened()) {
                assert!((found - truth).abs() < 1e-10, "degree {degree}: {found} where {truth} was");
            }
        }
    }

    /// The same problem as a tall dense system, solved by Householder reflections and never by normal equations.
    fn dense(degree: u8, ridge: f64, samples: &[(DVec3, [f64; 3], f64)]) -> Coefficients {
        let n = harmonics::functions(degree);
        let total: f64 = samples.iter().map(|(.., weight)| weight).sum();
        let mut rows: Vec<(Vec<f64>, [f64; 3])> = samples
            .iter()
            .map(|(direction, color, weight)| {
                let root = weight.sqrt();
                let basis = harmonics::basis(*direction);
                (basis[..n].iter().map(|b| root * b).collect(), color.map(|c| root * c))
            })
            .collect();
        for function in 0..n {
            let degree = f64::from(harmonics::degree_of(function));
            let mut row = vec![0.0; n];
            row[function] = (ridge * total).sqrt() * degree * (degree + 1.0);
            rows.push((row, [0.0; 3]));
        }
        for pivot in 0..n {
            let norm = rows[pivot..].iter().map(|(row, _)| row[pivot].powi(2)).sum::<f64>().sqrt();
            let mut mirror: Vec<f64> = rows[pivot..].iter().map(|(row, _)| row[pivot]).collect();
            mirror[0] += norm.copysign(mirror[0]);
            let scale = 2.0 / mirror.iter().map(|v| v * v).sum::<f64>();
            for column in 0..n + 3 {
                let at =
                    |row: &(Vec<f64>, [f64; 3])| if column < n { row.0[column] } else { row.1[column - n] };
                let product: f64 = rows[pivot..].iter().zip(&mirror).map(|(row, v)| at(row) * v).sum();
                for (row, v) in rows[pivot..].iter_mut().zip(&mirror) {
                    let place = if column < n { &mut row.0[column] } else { &mut row.1[column - n] };
                    *place -= scale * product * v;
                }
            }
        }
        let mut solution = [[0.0; 3]; SH_COEFFICIENTS];
        for row in (0..n).rev() {
            solution[row] = [0, 1, 2].map(|channel| {
                let known: f64 = (row + 1..n).map(|k| rows[row].0[k] * solution[k][channel]).sum();
                (rows[row].1[channel] - known) / rows[row].0[row]
            });
        }
        solution
    }

    #[test]
    fn the_fit_is_that_of_a_dense_least_squares_solver() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        for (degree, ridge) in [(1, 0.0), (3, 0.0), (2, 1e-3), (3, 1e-4), (3, 0.1)] {
            // Colors that no band holds, seen from one half of the sphere only.
            let samples: Vec<_> = directions(60, u64::from(degree) + 10)
                .into_iter()
                .map(|d| DVec3::new(d.x, d.y, d.z.abs()))
                .map(|d| (d, [(); 3].map(|()| rng.random_range(0.0..1.0)), rng.random_range(0.0..1.0)))
                .collect();
            let (found, expected) = (fitted(degree, ridge, &samples), dense(degree, ridge, &samples));
            for (found, expected) in found.as_flattened().iter().zip(expected.as_flattened()) {
                let tolerance = 1e-8 * expected.abs().max(1.0);
                assert!((found - expected).abs() < tolerance, "degree {degree}: {found} and {expected}");
            }
        }
    }

    #[test]
    fn a_color_seen_from_one_side_is_kept_on_the_other() {
        let samples: Vec<_> = directions(5, 1)
            .into_iter()
            .map(|d| (DVec3::new(0.1 * d.x, 0.1 * d.y, 1.0).normalize(), [0.3, -0.2, 0.1], 1.0))
            .collect();
        let found = fitted(3, 1e-3, &samples);
        for direction in directions(50, 2) {
            for (found, expected) in color(&found, direction).into_iter().zip([0.3, -0.2, 0.1]) {
                assert!((found - expected).abs() < 1e-9, "{found} where {expected} was seen");
            }
        }
    }

    #[test]
    fn what_the_samples_do_not_determine_is_zero_and_nothing_is_infinite() {
        assert_eq!(fitted(3, 1e-3, &[]), [[0.0; 3]; SH_COEFFICIENTS]);
        let one = fitted(3, 0.0, &[(DVec3::Z, [1.0, 0.5, 0.0], 2.0)]);
        assert!((color(&one, DVec3::Z)[0] - 1.0).abs() < 1e-12);
        assert!(one.as_flattened().iter().all(|value| value.is_finite()));
    }
}
