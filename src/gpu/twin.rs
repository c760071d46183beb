//! The primitives on the CPU, written plainly: what the kernels must reproduce bit for bit.

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

/// Pairs of key and value in stable order of the lowest `bits` bits of the key.
#[must_use]
pub fn radix_sort(pairs: &[(u32, u32)], bits: u32) -> Vec<(u32, u32)> {
    let mask = u32::try_from((1_u64 << bits.min(32)) - 1).unwrap_or(u32::MAX);
    let mut sorted = pairs.to_vec();
    sorted.sort_by_key(|(key, _)| key & mask);
    sorted
}
