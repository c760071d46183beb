//! CPU twins of the primitives: the kernels must reproduce them bit for bit.

use super::BLOCK;

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

/// The part of `count` elements that invocation `run` of `runs` owns.
fn owned(count: usize, runs: usize, run: usize) -> std::ops::Range<usize> {
    let length = count.div_ceil(runs);
    let begin = (run * length).min(count);
    begin..(begin + length).min(count)
}

/// The saturating sum of each run.
#[must_use]
pub fn scan_reduce(values: &[u32], runs: usize) -> Vec<u32> {
    (0..runs).map(|run| scan(&values[owned(values.len(), runs, run)]).1).collect()
}

/// The sums of the runs before each run, and the total.
#[must_use]
pub fn scan_partials(partials: &[u32]) -> (Vec<u32>, u32) {
    scan(partials)
}

/// The prefix sums of all values from those of the runs.
#[must_use]
pub fn scan_apply(values: &[u32], starts: &[u32]) -> Vec<u32> {
    let mut sums = Vec::with_capacity(values.len());
    for (run, start) in starts.iter().enumerate() {
        let mut sum = *start;
        for value in &values[owned(values.len(), starts.len(), run)] {
            sums.push(sum);
            sum = sum.saturating_add(*value);
        }
    }
    sums
}

/// How often each digit occurs in each run, `[digit][run]`; the digit of a key is `(key >> shift) % digits`.
#[must_use]
pub fn sort_count(keys: &[u32], shift: u32, digits: u32, runs: usize) -> Vec<u32> {
    let mut counters = vec![0; digits as usize * runs];
    for run in 0..runs {
        for key in &keys[owned(keys.len(), runs, run)] {
            counters[((key >> shift) % digits) as usize * runs + run] += 1;
        }
    }
    counters
}

/// For each digit the exclusive prefix sums of its counters over the runs, and its total.
#[must_use]
pub fn sort_offsets(counters: &[u32], runs: usize) -> (Vec<u32>, Vec<u32>) {
    let (offsets, totals): (Vec<_>, Vec<_>) = counters.chunks(runs).map(scan).unzip();
    (offsets.concat(), totals)
}

/// One stable pass: each pair goes to the place of its digit and run, runs and pairs in order.
#[must_use]
pub fn sort_scatter(
    pairs: &[(u32, u32)],
    shift: u32,
    digits: u32,
    offsets: &[u32],
    totals: &[u32],
) -> Vec<(u32, u32)> {
    let runs = offsets.len() / digits as usize;
    let (bases, _) = scan(totals);
    let mut next: Vec<u32> = offsets.iter().enumerate().map(|(i, offset)| offset + bases[i / runs]).collect();
    let mut sorted = vec![(0, 0); pairs.len()];
    for run in 0..runs {
        for pair in &pairs[owned(pairs.len(), runs, run)] {
            let place = &mut next[((pair.0 >> shift) % digits) as usize * runs + run];
            sorted[*place as usize] = *pair;
            *place += 1;
        }
    }
    sorted
}

/// The number of values, then the saturating sum of each block.
#[must_use]
pub fn scan_block_sums(values: &[u32]) -> Vec<u32> {
    std::iter::once(values.len() as u32).chain(values.chunks(BLOCK).map(|block| scan(block).1)).collect()
}

/// The prefix sums of all values from the partial sums of [`scan_block_sums`], and the total.
#[must_use]
pub fn scan_blocks(values: &[u32], partials: &[u32]) -> (Vec<u32>, u32) {
    let (starts, total) = scan(&partials[1..]);
    let from = |(block, start): (&[u32], &u32)| {
        scan(block).0.into_iter().map(|sum| sum.saturating_add(*start)).collect::<Vec<_>>()
    };
    (values.chunks(BLOCK).zip(&starts).flat_map(from).collect(), total)
}

/// How often each digit occurs in each block, `[digit][block]`; the digit of a key is `(key >> shift) % digits`.
#[must_use]
pub fn radix_histogram(keys: &[u32], shift: u32, digits: u32) -> Vec<u32> {
    let blocks = keys.len().div_ceil(BLOCK);
    let mut counters = vec![0; digits as usize * blocks];
    for (block, keys) in keys.chunks(BLOCK).enumerate() {
        for key in keys {
            counters[((key >> shift) % digits) as usize * blocks + block] += 1;
        }
    }
    counters
}

/// For each digit the exclusive prefix sums of its counters over the blocks, and its total.
#[must_use]
pub fn radix_scan(counters: &[u32], blocks: usize) -> (Vec<u32>, Vec<u32>) {
    sort_offsets(counters, blocks)
}

/// One stable pass: each pair goes to the place of its digit and block, blocks and pairs in order.
#[must_use]
pub fn radix_scatter(
    pairs: &[(u32, u32)],
    shift: u32,
    digits: u32,
    counters: &[u32],
    totals: &[u32],
) -> Vec<(u32, u32)> {
    let blocks = pairs.len().div_ceil(BLOCK);
    let (bases, _) = scan(totals);
    let mut sorted = vec![(0, 0); pairs.len()];
    for (block, pairs) in pairs.chunks(BLOCK).enumerate() {
        let mut next: Vec<usize> = (0..digits as usize)
            .map(|digit| (bases[digit] + counters[digit * blocks + block]) as usize)
            .collect();
        for pair in pairs {
            let place = &mut next[((pair.0 >> shift) % digits) as usize];
            sorted[*place] = *pair;
            *place += 1;
        }
    }
    sorted
}

/// Which of `count` parts of the work a workgroup does on a software adapter (`shaders/shared/spread.wgsl`): parts in order, dealt out
/// alternately four times.
#[must_use]
pub fn part_of(workgroup: u32, count: u32) -> u32 {
    let half = count.div_ceil(2);
    (0..4).fold(workgroup, |part, _| if part < half { 2 * part } else { 2 * (part - half) + 1 })
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::gpu::{DeviceSettings, KernelSource, KernelVariant, testing::lavapipe_with};

    #[test]
    fn every_sixteenth_of_the_workgroups_does_parts_from_everywhere() {
        for count in [1_u32, 2, 3, 15, 16, 17, 40, 64, 333, 1000] {
            let parts: Vec<u32> = (0..count).map(|workgroup| part_of(workgroup, count)).collect();
            let mut sorted = parts.clone();
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..count), "{count} parts, each once");
            for run in parts.chunks_exact((count as usize / 16).max(1)).filter(|run| run.len() > 10) {
                let early = run.iter().filter(|part| **part < count / 3).count() as f64 / run.len() as f64;
                assert!((early - 1.0 / 3.0).abs() < 0.1, "{early} of {run:?}");
            }
        }
    }

    #[test]
    fn kernels_deal_out_parts_as_their_variant_does() {
        const TEXT: &str = "
            #import tcgs::spread::part_of
            @group(0) @binding(0) var<storage, read_write> parts: array<u32>;
            @compute @workgroup_size(1)
            fn deal(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u) {
                parts[group.x + group.y * 65535u] = part_of(group, groups);
            }";
        let source = KernelSource { name: "deal", text: TEXT };
        for variant in [KernelVariant::Software, KernelVariant::Hardware] {
            let device =
                lavapipe_with(&DeviceSettings { variant: Some(variant), ..DeviceSettings::default() });
            let kernel = device.kernel(source, &[]).expect("a kernel");
            // The last takes two dimensions of workgroups.
            for (asked, count) in [(1, 1), (77, 77), (65_536, 2 * 65_535)] {
                let parts = device.buffer::<u32>("parts", count).expect("room");
                let mut recorder = device.recorder("deal");
                recorder.dispatch(&kernel, &[&parts], asked);
                recorder.submit().expect("submitted");
                let of = |group| variant.choose(part_of(group, count as u32), group);
                assert!(device.read(&parts).expect("read").into_iter().eq((0..count as u32).map(of)));
            }
        }
    }

    const SIZES: [usize; 10] = [0, 1, 2, 31, 32, 33, 257, 2048, 2049, 5000];

    #[test]
    fn the_steps_of_a_scan_make_a_scan() {
        let mut rng = Pcg64::seed_from_u64(1);
        for count in SIZES {
            for (runs, largest) in [(1, 9), (7, 9), (128, 9), (7, u32::MAX)] {
                let values: Vec<u32> = (0..count).map(|_| rng.random_range(0..largest)).collect();
                let (starts, total) = scan_partials(&scan_reduce(&values, runs));
                assert_eq!((scan_apply(&values, &starts), total), scan(&values), "{count} in {runs} runs");
                assert_eq!(
                    scan_blocks(&values, &scan_block_sums(&values)),
                    scan(&values),
                    "{count} in blocks"
                );
            }
        }
    }

    #[test]
    fn the_steps_of_a_sort_make_a_stable_sort() {
        let mut rng = Pcg64::seed_from_u64(2);
        for count in SIZES {
            for (runs, digit_bits) in [(1, 8), (7, 4), (128, 8)] {
                let mut pairs: Vec<(u32, u32)> =
                    (0..count as u32).map(|i| (rng.random_range(0..500), i)).collect();
                let expected = radix_sort(&pairs, 16);
                let digits = 1 << digit_bits;
                for shift in (0..16).step_by(digit_bits) {
                    let keys: Vec<u32> = pairs.iter().map(|(key, _)| *key).collect();
                    let (offsets, totals) =
                        sort_offsets(&sort_count(&keys, shift as u32, digits, runs), runs);
                    pairs = sort_scatter(&pairs, shift as u32, digits, &offsets, &totals);
                }
                assert_eq!(pairs, expected, "{count} in {runs} runs");
            }
        }
    }

    #[test]
    fn the_steps_of_a_sort_of_blocks_make_a_stable_sort() {
        let mut rng = Pcg64::seed_from_u64(3);
        for count in SIZES {
            let mut pairs: Vec<(u32, u32)> =
                (0..count as u32).map(|i| (rng.random_range(0..500), i)).collect();
            let expected = radix_sort(&pairs, 9);
            for (shift, digits) in [(0, 32), (5, 16)] {
                let keys: Vec<u32> = pairs.iter().map(|(key, _)| *key).collect();
                let counters = radix_histogram(&keys, shift, digits);
                let blocks = count.div_ceil(BLOCK);
                let (offsets, totals) = if blocks == 0 {
                    (vec![], vec![0; digits as usize])
                } else {
                    radix_scan(&counters, blocks)
                };
                pairs = radix_scatter(&pairs, shift, digits, &offsets, &totals);
            }
            assert_eq!(pairs, expected, "{count}");
        }
    }
}
