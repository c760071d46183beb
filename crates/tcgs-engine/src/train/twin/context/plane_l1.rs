//! The difference of planes and their reconstruction.

/// The weighted mean absolute difference of planes and their reconstruction, and its gradient by the planes; that by the
/// reconstruction is the opposite.
#[must_use]
pub fn plane_l1(planes: &[f64], reconstruction: &[f64], weight: f64) -> (f64, Vec<f64>) {
    let share = weight / planes.len() as f64;
    let differences: Vec<f64> = planes.iter().zip(reconstruction).map(|(a, b)| a - b).collect();
    let sign = |v: &f64| if *v == 0.0 { 0.0 } else { share * v.signum() };
    (share * differences.iter().map(|v| v.abs()).sum::<f64>(), differences.iter().map(sign).collect())
}
