//! The steps of scan and sort make what one go makes.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{
    radix_histogram, radix_scan, radix_scatter, radix_sort, scan, scan_apply, scan_block_sums, scan_blocks,
    scan_partials, scan_reduce, sort_count, sort_offsets, sort_scatter,
};
use crate::gpu::BLOCK;

const SIZES: [usize; 10] = [0, 1, 2, 31, 32, 33, 257, 2048, 2049, 5000];

#[test]
fn the_steps_of_a_scan_make_a_scan() {
    let mut rng = Pcg64::seed_from_u64(1);
    for count in SIZES {
        for (runs, largest) in [(1, 9), (7, 9), (128, 9), (7, u32::MAX)] {
            let values: Vec<u32> = (0..count).map(|_| rng.random_range(0..largest)).collect();
            let (starts, total) = scan_partials(&scan_reduce(&values, runs));
            assert_eq!((scan_apply(&values, &starts), total), scan(&values), "{count} in {runs} runs");
            assert_eq!(scan_blocks(&values, &scan_block_sums(&values)), scan(&values), "{count} in blocks");
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
                let (offsets, totals) = sort_offsets(&sort_count(&keys, shift as u32, digits, runs), runs);
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
        let mut pairs: Vec<(u32, u32)> = (0..count as u32).map(|i| (rng.random_range(0..500), i)).collect();
        let expected = radix_sort(&pairs, 9);
        for (shift, digits) in [(0, 32), (5, 16)] {
            let keys: Vec<u32> = pairs.iter().map(|(key, _)| *key).collect();
            let counters = radix_histogram(&keys, shift, digits);
            let blocks = count.div_ceil(BLOCK);
            let (offsets, totals) =
                if blocks == 0 { (vec![], vec![0; digits as usize]) } else { radix_scan(&counters, blocks) };
            pairs = radix_scatter(&pairs, shift, digits, &offsets, &totals);
        }
        assert_eq!(pairs, expected, "{count}");
    }
}
