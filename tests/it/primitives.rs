//! Scan and sort on the device against their twins.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::gpu::{Context, Pairs, RadixSort, Scan, ScanSlots, twin};

use crate::support::gpu::gpu;

const SIZES: [usize; 9] = [0, 1, 2, 127, 128, 129, 5_000, 77_777, 1_000_003];

fn junk(context: &Context, len: usize) -> tcgs::gpu::Buffer<u32> {
    context.upload("junk", &vec![0xdead_beef_u32; len]).expect("a buffer")
}

#[test]
fn scan_matches_its_twin() {
    let context = gpu();
    let mut rng = Pcg64::seed_from_u64(1);
    for size in SIZES {
        let values: Vec<u32> = (0..size).map(|_| rng.random_range(0..50)).collect();
        let scan = Scan::new(&context, size, ScanSlots { count: 1, total: 2 }).expect("a scan");
        let counts = context.upload("counts", &[7, size as u32, 9]).expect("counts");
        let input = context.upload("values", &values).expect("values");
        let (sums, totals) = (junk(&context, size), junk(&context, 4));
        let mut recorder = context.recorder("scan");
        scan.record(&mut recorder, &counts, &input, &sums, &totals);
        recorder.submit().expect("submitted");
        let (expected, total) = twin::scan(&values);
        assert_eq!(context.read(&sums).expect("sums"), expected, "{size}");
        assert_eq!(
            context.read(&totals).expect("totals"),
            [0xdead_beef, 0xdead_beef, total, 0xdead_beef],
            "{size}"
        );
    }
}

#[test]
fn scan_saturates_and_stops_at_the_count() {
    let context = gpu();
    let values = vec![u32::MAX / 3; 1000];
    let scan = Scan::new(&context, 1000, ScanSlots { count: 0, total: 0 }).expect("a scan");
    let counts = context.upload("counts", &[600_u32]).expect("counts");
    let input = context.upload("values", &values).expect("values");
    let (sums, totals) = (junk(&context, 1000), junk(&context, 1));
    let mut recorder = context.recorder("scan");
    scan.record(&mut recorder, &counts, &input, &sums, &totals);
    recorder.submit().expect("submitted");
    let sums = context.read(&sums).expect("sums");
    assert_eq!(sums[..600], twin::scan(&values[..600]).0);
    assert!(sums[600..].iter().all(|sum| *sum == 0xdead_beef), "beyond the count nothing is written");
    assert_eq!(context.read(&totals).expect("totals"), [u32::MAX]);
}

#[test]
fn sort_matches_its_twin_and_is_stable() {
    let context = gpu();
    let mut rng = Pcg64::seed_from_u64(2);
    for size in SIZES {
        for bits in [1, 7, 9, 32] {
            let keys: Vec<u32> = (0..size).map(|_| rng.random::<u32>() >> rng.random_range(0..24)).collect();
            let values: Vec<u32> = (0..size as u32).collect();
            let sort = RadixSort::new(&context, size, bits, 0).expect("a sort");
            let counts = context.upload("counts", &[size as u32]).expect("counts");
            let pairs = Pairs {
                keys: context.upload("keys", &keys).expect("keys"),
                values: context.upload("values", &values).expect("values"),
            };
            let spare = Pairs { keys: junk(&context, size), values: junk(&context, size) };
            let mut recorder = context.recorder("sort");
            let sorted = sort.record(&mut recorder, &counts, &pairs, &spare);
            recorder.submit().expect("submitted");
            let pairs: Vec<(u32, u32)> = keys.into_iter().zip(values).collect();
            let (keys, values): (Vec<u32>, Vec<u32>) = twin::radix_sort(&pairs, bits).into_iter().unzip();
            assert!(context.read(&sorted.keys).expect("keys") == keys, "{size} keys by {bits} bits");
            assert!(context.read(&sorted.values).expect("values") == values, "{size} values by {bits} bits");
        }
    }
}

#[test]
fn recorded_writes_take_effect_in_order() {
    let context = gpu();
    let (buffer, copy) = (context.buffer("b", 3).expect("room"), context.buffer("c", 3).expect("room"));
    let mut recorder = context.recorder("writes");
    recorder.write(&buffer, &[1_u32, 2, 3]);
    recorder.copy(&buffer, 0, &copy, 0, 3);
    recorder.write(&buffer, &[7_u32]);
    recorder.write::<u32>(&buffer, &[]);
    recorder.submit().expect("submitted");
    assert_eq!(context.read(&copy).expect("read"), [1, 2, 3]);
    assert_eq!(context.read(&buffer).expect("read"), [7, 2, 3]);
}

#[test]
fn timed_dispatches_are_named_in_order() {
    let context = gpu();
    let scan = Scan::new(&context, 100, ScanSlots { count: 0, total: 0 }).expect("a scan");
    let counts = context.upload("counts", &[100_u32]).expect("counts");
    let (values, sums, totals) = (junk(&context, 100), junk(&context, 100), junk(&context, 1));
    let mut recorder = context.timed_recorder("scan");
    scan.record(&mut recorder, &counts, &values, &sums, &totals);
    let names: Vec<_> = recorder.submit_timed().expect("submitted").iter().map(|time| time.name).collect();
    if context.adapter().timestamps {
        assert_eq!(names, ["scan_reduce", "scan_partials", "scan_apply"]);
    } else {
        assert!(names.is_empty());
    }
    assert_eq!(context.read(&totals).expect("totals"), [u32::MAX]);
}
