//! Norms of differences. A value that is not a number makes every norm NaN.

/// The larger of two, or NaN if one is NaN.
fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) }
}

/// The largest of several, NaN if one is, 0 of none.
pub(super) fn largest(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().fold(0.0, larger)
}

/// |found - truth| / |truth| in L2, or |found| where the truth vanishes; NaN if the lengths differ.
pub(super) fn relative_l2(found: &[f64], truth: &[f64]) -> f64 {
    if found.len() != truth.len() {
        return f64::NAN;
    }
    // Scaled, so that squares of values near the ends of f32 neither vanish nor overflow.
    let scale = largest(truth.iter().map(|v| v.abs()));
    let scale = if scale == 0.0 { 1.0 } else { scale };
    let square = |v: f64| (v / scale) * (v / scale);
    let difference: f64 = found.iter().zip(truth).map(|(a, b)| square(a - b)).sum();
    let size: f64 = truth.iter().map(|b| square(*b)).sum();
    if size == 0.0 { difference.sqrt() } else { (difference / size).sqrt() }
}

/// The largest absolute difference; NaN if the lengths differ.
pub(super) fn largest_difference(found: &[f64], truth: &[f64]) -> f64 {
    if found.len() != truth.len() {
        return f64::NAN;
    }
    largest(found.iter().zip(truth).map(|(a, b)| (a - b).abs()))
}

/// 0 if `held`, else 1: the error of a yes-or-no question.
pub(super) fn unless(held: bool) -> f64 {
    f64::from(u8::from(!held))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn norms_are_those_of_the_definitions_and_nothing_hides_a_nan() {
        assert_eq!(relative_l2(&[3.0, 5.0], &[3.0, 4.0]), 0.2);
        assert_eq!(relative_l2(&[3.0, 4.0], &[0.0, 0.0]), 5.0);
        assert_eq!(relative_l2(&[2e-200], &[1e-200]), 1.0);
        assert_eq!(largest_difference(&[1.0, -2.0], &[1.5, -1.0]), 1.0);
        assert!(largest([1.0, f64::NAN, 2.0]).is_nan());
        assert!(largest_difference(&[f64::NAN, 1.0], &[0.0, 0.0]).is_nan());
        assert!(relative_l2(&[f64::NAN], &[1.0]).is_nan() && relative_l2(&[1.0], &[]).is_nan());
    }
}
