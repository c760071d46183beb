//! Eigenvalues and eigenvectors of small symmetric matrices, by cyclic Jacobi rotations.
//!
//! Invariant: only the four operations and square roots of IEEE 754, in a fixed order, so that every host has the same bits. (A
//! library's routines choose instructions by the processor.)

/// Sweeps after which the off-diagonal elements of any matrix of finite numbers are lost in rounding; a dozen are usual.
const MAX_SWEEPS: usize = 64;

/// The eigenvalues of the symmetric `matrix` `[n][n]`, descending, and `[n][n]` with the unit eigenvector of each in its row.
pub fn symmetric_eigen(matrix: &[f64], n: usize) -> (Vec<f64>, Vec<f64>) {
    let mut a = matrix.to_vec();
    let mut vectors: Vec<f64> = (0..n * n).map(|i| if i / n == i % n { 1.0 } else { 0.0 }).collect();
    let scale = a.iter().map(|value| value * value).sum::<f64>();
    for _ in 0..MAX_SWEEPS {
        let off: f64 = (0..n)
            .flat_map(|i| (0..i).map(move |j| (i, j)))
            .map(|(i, j)| 2.0 * a[i * n + j] * a[i * n + j])
            .sum();
        // Nothing is done for numbers that are not finite.
        if off.is_nan() || off <= 1e-30 * scale {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                rotate(&mut a, &mut vectors, n, p, q);
            }
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|i, j| a[j * n + j].total_cmp(&a[i * n + i]));
    let values = order.iter().map(|i| a[i * n + i]).collect();
    let rows = order.iter().flat_map(|i| vectors[i * n..(i + 1) * n].to_vec()).collect();
    (values, rows)
}

/// One rotation of the axes `p` and `q`, after which their element is zero.
fn rotate(a: &mut [f64], vectors: &mut [f64], n: usize, p: usize, q: usize) {
    let element = a[p * n + q];
    if element == 0.0 {
        return;
    }
    let theta = (a[q * n + q] - a[p * n + p]) / (2.0 * element);
    let tangent = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let cosine = 1.0 / (tangent * tangent + 1.0).sqrt();
    let sine = tangent * cosine;
    let turned = |x: f64, y: f64| (cosine * x - sine * y, sine * x + cosine * y);
    for i in 0..n {
        (a[i * n + p], a[i * n + q]) = turned(a[i * n + p], a[i * n + q]);
    }
    for i in 0..n {
        (a[p * n + i], a[q * n + i]) = turned(a[p * n + i], a[q * n + i]);
        (vectors[p * n + i], vectors[q * n + i]) = turned(vectors[p * n + i], vectors[q * n + i]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_matrix_is_the_sum_of_its_eigenvectors_products() {
        for n in [1, 2, 3, 8, 50] {
            let random = |i: usize| (((i * 7919 + 104_729) % 1_000) as f64 / 500.0 - 1.0).powi(3);
            let matrix: Vec<f64> =
                (0..n * n).map(|i| random((i / n).min(i % n) * n + (i / n).max(i % n))).collect();
            let (values, vectors) = symmetric_eigen(&matrix, n);
            assert!(values.is_sorted_by(|a, b| a >= b));
            for i in 0..n {
                for j in 0..n {
                    let dot: f64 = (0..n).map(|k| vectors[i * n + k] * vectors[j * n + k]).sum();
                    assert!((dot - if i == j { 1.0 } else { 0.0 }).abs() < 1e-12);
                    let sum: f64 = (0..n).map(|k| values[k] * vectors[k * n + i] * vectors[k * n + j]).sum();
                    assert!((sum - matrix[i * n + j]).abs() < 1e-11, "{n}: {sum} for {}", matrix[i * n + j]);
                }
            }
        }
    }

    #[test]
    fn diagonal_zero_and_nonsense_matrices_end() {
        let (values, vectors) = symmetric_eigen(&[1.0, 0.0, 0.0, 5.0], 2);
        assert_eq!((values, vectors), (vec![5.0, 1.0], vec![0.0, 1.0, 1.0, 0.0]));
        assert_eq!(symmetric_eigen(&[0.0; 9], 3).0, [0.0; 3]);
        assert_eq!(symmetric_eigen(&[], 0), (vec![], vec![]));
        assert_eq!(symmetric_eigen(&[f64::NAN; 4], 2).0.len(), 2);
    }
}
