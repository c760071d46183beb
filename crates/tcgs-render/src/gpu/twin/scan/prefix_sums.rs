//! Prefix sums in one go: what the steps of a scan make together.

/// Exclusive saturating prefix sums, and the total.
#[must_use]
pub fn scan(values: &[u32]) -> (Vec<u32>, u32) {
    let mut total = 0_u32;
    let mut sums = Vec::with_capacity(values.len());
    for value in values {
        sums.push(total);
        total = total.saturating_add(*value);
    }
    (sums, total)
}
