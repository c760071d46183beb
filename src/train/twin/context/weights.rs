//! Values in the form in which they are stored, and what the way there costs.

/// Most binary places of a weight.
const MOST_PLACES: i32 = 15;

/// Latents as the nearest multiples of 1/16 with integers of at most 127.
#[must_use]
pub fn round_latents(values: &[f64]) -> Vec<f64> {
    values.iter().map(|value| (16.0 * value).round_ties_even().clamp(-127.0, 127.0) / 16.0).collect()
}

/// One output's weights as integers of at most `levels` over the largest power of two up to 2^15 that they allow.
#[must_use]
pub fn round_weights(row: &[f64], levels: u8) -> Vec<f64> {
    let levels = f64::from(levels);
    let largest = row.iter().fold(0.0, |largest: f64, weight| largest.max(weight.abs()));
    let places =
        (1..=MOST_PLACES).rev().find(|places| (largest * 2_f64.powi(*places)).round_ties_even() <= levels);
    let scale = 2_f64.powi(places.unwrap_or(0));
    row.iter().map(|weight| (weight * scale).round_ties_even().clamp(-levels, levels) / scale).collect()
}

/// The weighted mean absolute difference of planes and their reconstruction, and its gradient by the planes; that by the
/// reconstruction is the opposite.
#[must_use]
pub fn plane_l1(planes: &[f64], reconstruction: &[f64], weight: f64) -> (f64, Vec<f64>) {
    let share = weight / planes.len() as f64;
    let differences: Vec<f64> = planes.iter().zip(reconstruction).map(|(a, b)| a - b).collect();
    let sign = |v: &f64| if *v == 0.0 { 0.0 } else { share * v.signum() };
    (share * differences.iter().map(|v| v.abs()).sum::<f64>(), differences.iter().map(sign).collect())
}
