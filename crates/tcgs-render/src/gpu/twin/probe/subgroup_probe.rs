//! What workgroups of one subgroup compute if their lanes are in order.

/// Expected output of each invocation of `groups` workgroups of `lanes` that occupy the first lanes of one subgroup: the
/// mirrored lane's index, the sum of all of the workgroup's indices, and the ballot of every third lane.
#[must_use]
pub fn subgroup_probe(lanes: u32, groups: u32) -> Vec<[u32; 4]> {
    let ballot = (0..lanes).filter(|lane| lane % 3 == 0).fold(0_u64, |bits, lane| bits | 1 << lane);
    (0..groups * lanes)
        .map(|index| {
            let first = index / lanes * lanes;
            let mirrored = first + lanes - 1 - index % lanes;
            let sum = (first..first + lanes).sum();
            [mirrored, sum, ballot as u32, (ballot >> 32) as u32]
        })
        .collect()
}
