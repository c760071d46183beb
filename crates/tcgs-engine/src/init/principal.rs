//! Principal components of rows of which some values are missing.
//!
//! The result depends on the values only: all sums go in the order of the rows, in f64.

use super::symmetric_eigen::symmetric_eigen;

/// Rounds in which missing values are replaced by the components' values.
const ROUNDS: usize = 3;

/// Rows as a mean and a few coordinates along orthonormal directions.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Components {
    /// `[D]`.
    pub mean: Vec<f64>,
    /// `[R][D]`, by falling variance.
    pub directions: Vec<Vec<f64>>,
    /// `[N][R]`.
    pub coordinates: Vec<f64>,
}

/// The `count` principal components of `rows`, `[N][D]` with D = `width`; where `known` is false a value only begins as given and is
/// then taken from the components.
pub(super) fn principal_components(
    mut rows: Vec<f64>,
    known: &[bool],
    width: usize,
    count: usize,
) -> Components {
    let count = count.min(width);
    let mut found = components_of(&rows, width, count);
    for _ in 1..ROUNDS {
        for ((row, known), coordinates) in rows
            .chunks_exact_mut(width)
            .zip(known.chunks_exact(width))
            .zip(found.coordinates.chunks_exact(count.max(1)))
        {
            for column in (0..width).filter(|column| !known[*column]) {
                let along = found.directions.iter().zip(coordinates);
                row[column] =
                    found.mean[column] + along.map(|(direction, z)| direction[column] * z).sum::<f64>();
            }
        }
        found = components_of(&rows, width, count);
    }
    found
}

fn components_of(rows: &[f64], width: usize, count: usize) -> Components {
    let len = (rows.len() / width).max(1) as f64;
    let mut mean = vec![0.0; width];
    for row in rows.chunks_exact(width) {
        for (sum, value) in mean.iter_mut().zip(row) {
            *sum += value / len;
        }
    }
    let mut covariance = vec![0.0; width * width];
    let mut centered = vec![0.0; width];
    for row in rows.chunks_exact(width) {
        for ((to, value), mean) in centered.iter_mut().zip(row).zip(&mean) {
            *to = value - mean;
        }
        for (i, a) in centered.iter().enumerate() {
            for (sum, b) in covariance[i * width..][..=i].iter_mut().zip(&centered) {
                *sum += a * b;
            }
        }
    }
    for i in 0..width {
        for j in 0..=i {
            let value = covariance[i * width + j] / len;
            (covariance[i * width + j], covariance[j * width + i]) = (value, value);
        }
    }
    let directions = largest_eigenvectors(&covariance, width, count);
    let along = |direction: &[f64], row: &[f64]| -> f64 {
        direction.iter().zip(row).zip(&mean).map(|((d, value), mean)| d * (value - mean)).sum()
    };
    let mut coordinates = Vec::with_capacity(rows.len() / width * count);
    for row in rows.chunks_exact(width) {
        coordinates.extend(directions.iter().map(|direction| along(direction, row)));
    }
    Components { mean, directions, coordinates }
}

/// The eigenvectors of the `count` largest eigenvalues of a symmetric matrix.
fn largest_eigenvectors(matrix: &[f64], width: usize, count: usize) -> Vec<Vec<f64>> {
    let (_, vectors) = symmetric_eigen(matrix, width);
    vectors.chunks_exact(width).take(count).map(<[f64]>::to_vec).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows in a plane of three dimensions through (1, 2, 3).
    fn plane(len: usize) -> Vec<f64> {
        (0..len)
            .flat_map(|i| {
                let (a, b) = (((i * 37) % 101) as f64 / 50.0 - 1.0, ((i * 53) % 89) as f64 / 200.0 - 0.2);
                [1.0 + a + b, 2.0 - a + b, 3.0 + 0.5 * a - b]
            })
            .collect()
    }

    fn worst(found: &Components, rows: &[f64]) -> f64 {
        let count = found.directions.len();
        let mut worst: f64 = 0.0;
        for (row, z) in rows.chunks_exact(3).zip(found.coordinates.chunks_exact(count)) {
            for column in 0..3 {
                let again: f64 = found.mean[column]
                    + found.directions.iter().zip(z).map(|(d, z)| d[column] * z).sum::<f64>();
                worst = worst.max((again - row[column]).abs());
            }
        }
        worst
    }

    #[test]
    fn rows_of_a_plane_are_two_coordinates_along_orthonormal_directions() {
        let rows = plane(300);
        let found = principal_components(rows.clone(), &vec![true; rows.len()], 3, 2);
        assert!(worst(&found, &rows) < 1e-12);
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let [first, second] = &found.directions[..] else { panic!("two directions") };
        for (found, expected) in
            [(dot(first, first), 1.0), (dot(second, second), 1.0), (dot(first, second), 0.0)]
        {
            assert!((found - expected).abs() < 1e-12);
        }
        let one = principal_components(rows.clone(), &vec![true; rows.len()], 3, 1);
        assert!(worst(&one, &rows) > 0.05, "the plane's second direction is missing");
        assert!(one.directions[0].iter().zip(first).all(|(a, b)| (a.abs() - b.abs()).abs() < 1e-12));
    }

    #[test]
    fn missing_values_are_drawn_to_what_the_components_say() {
        let rows = plane(300);
        let known: Vec<bool> = (0..rows.len()).map(|i| i % 30 != 7).collect();
        let holes: Vec<f64> =
            rows.iter().zip(&known).map(|(value, known)| if *known { *value } else { 2.0 }).collect();
        let once = worst(&components_of(&holes, 3, 2), &rows);
        let filled = worst(&principal_components(holes, &known, 3, 2), &rows);
        assert!(filled < 0.5 * once, "{filled} after {once}");
    }

    #[test]
    fn rows_that_do_not_vary_have_finite_components() {
        let found = principal_components(vec![1.0; 12], &[true; 12], 3, 2);
        assert!(found.coordinates.iter().all(|z| z.abs() < 1e-12));
        assert!(found.directions.iter().flatten().all(|d| d.is_finite()));
    }
}
