//! A stable sort in one go: what the passes of a sort make together.

/// Pairs of key and value in stable order of the lowest `bits` bits of the key.
#[must_use]
pub fn radix_sort(pairs: &[(u32, u32)], bits: u32) -> Vec<(u32, u32)> {
    let mask = u32::try_from((1_u64 << bits.min(32)) - 1).unwrap_or(u32::MAX);
    let mut sorted = pairs.to_vec();
    sorted.sort_by_key(|(key, _)| key & mask);
    sorted
}
