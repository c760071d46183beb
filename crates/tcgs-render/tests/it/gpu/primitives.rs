//! Scan and sort on the device against their twins, in both variants; the device's limits and its recovery.

use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs_render::gpu::{
    Device, DeviceSettings, GpuError, KernelVariant, Pairs, RadixSort, Scan, ScanSlots, Subgroups, twin,
};

use crate::support::gpu::{gpu, gpu_with, variants};

const SIZES: [usize; 15] =
    [0, 1, 2, 127, 129, 255, 256, 257, 2047, 2048, 2049, 65_535, 65_536, 65_537, 1_000_003];

fn junk(device: &Device, len: usize) -> tcgs_render::gpu::Buffer<u32> {
    device.upload("junk", &vec![0xdead_beef_u32; len]).expect("a buffer")
}

#[test]
fn scan_matches_its_twin() {
    for device in variants() {
        let mut rng = Pcg64::seed_from_u64(1);
        for size in SIZES {
            let values: Vec<u32> = (0..size).map(|_| rng.random_range(0..50)).collect();
            let scan = Scan::plan(device.adapter(), size, ScanSlots { count: 1, total: 2 })
                .make(&device)
                .expect("a scan");
            let counts = device.upload("counts", &[7, size as u32, 9]).expect("counts");
            let input = device.upload("values", &values).expect("values");
            let (sums, totals) = (junk(&device, size), junk(&device, 4));
            let mut recorder = device.recorder("scan");
            scan.record(&mut recorder, &counts, &input, &sums, &totals);
            recorder.submit().expect("submitted");
            let (expected, total) = twin::scan(&values);
            let variant = device.variant();
            assert_eq!(device.read(&sums).expect("sums"), expected, "{size}, {variant:?}");
            assert_eq!(
                device.read(&totals).expect("totals"),
                [0xdead_beef, 0xdead_beef, total, 0xdead_beef],
                "{size}, {variant:?}"
            );
        }
    }
}

#[test]
fn scan_saturates_and_stops_at_the_count() {
    for device in variants() {
        let values = vec![u32::MAX / 3; 1000];
        let scan = Scan::plan(device.adapter(), 1000, ScanSlots { count: 0, total: 0 })
            .make(&device)
            .expect("a scan");
        let counts = device.upload("counts", &[600_u32]).expect("counts");
        let input = device.upload("values", &values).expect("values");
        let (sums, totals) = (junk(&device, 1000), junk(&device, 1));
        let mut recorder = device.recorder("scan");
        scan.record(&mut recorder, &counts, &input, &sums, &totals);
        recorder.submit().expect("submitted");
        let sums = device.read(&sums).expect("sums");
        assert_eq!(sums[..600], twin::scan(&values[..600]).0);
        assert!(sums[600..].iter().all(|sum| *sum == 0xdead_beef), "beyond the count nothing is written");
        assert_eq!(device.read(&totals).expect("totals"), [u32::MAX]);
    }
}

/// Compares a sort by `bits` bits with its twin.
fn assert_sorts(device: &Device, sort: &RadixSort, keys: &[u32], bits: u32) {
    let size = keys.len();
    let values: Vec<u32> = (0..size as u32).collect();
    let counts = device.upload("counts", &[size as u32]).expect("counts");
    let pairs = Pairs {
        keys: device.upload("keys", keys).expect("keys"),
        values: device.upload("values", &values).expect("values"),
    };
    let spare = Pairs { keys: junk(device, size), values: junk(device, size) };
    let mut recorder = device.recorder("sort");
    let sorted = sort.record(&mut recorder, &counts, &pairs, &spare);
    recorder.submit().expect("submitted");
    let pairs: Vec<(u32, u32)> = keys.iter().copied().zip(values).collect();
    let (keys, values): (Vec<u32>, Vec<u32>) = twin::radix_sort(&pairs, bits).into_iter().unzip();
    let what = format!("{size} by {bits} bits, {:?}", device.variant());
    assert!(device.read(&sorted.keys).expect("keys") == keys, "keys: {what}");
    assert!(device.read(&sorted.values).expect("values") == values, "values: {what}");
}

#[test]
fn sort_matches_its_twin_and_is_stable() {
    for device in variants() {
        let mut rng = Pcg64::seed_from_u64(2);
        for size in SIZES {
            for bits in [1, 7, 9, 32] {
                let keys: Vec<u32> =
                    (0..size).map(|_| rng.random::<u32>() >> rng.random_range(0..24)).collect();
                let sort = RadixSort::plan(device.adapter(), size, bits, 0).make(&device).expect("a sort");
                assert_sorts(&device, &sort, &keys, bits);
            }
        }
    }
}

#[test]
fn sort_keeps_equal_sorted_and_reversed_keys_in_order() {
    for device in variants() {
        for size in [255_usize, 257, 4096, 65_537, 1_000_000] {
            let sort = RadixSort::plan(device.adapter(), size, 32, 0).make(&device).expect("a sort");
            let of = |key: &dyn Fn(u32) -> u32| (0..size as u32).map(key).collect::<Vec<u32>>();
            let keys =
                [of(&|_| 0), of(&|_| u32::MAX), of(&|i| i * 4099), of(&|i| u32::MAX - i), of(&|i| i % 3)];
            for keys in keys {
                assert_sorts(&device, &sort, &keys, 32);
            }
        }
    }
}

/// Too slow for a software adapter in a debug build.
#[cfg(not(debug_assertions))]
#[test]
fn sort_of_ten_million_pairs_matches_its_twin() {
    for device in variants() {
        let mut rng = Pcg64::seed_from_u64(4);
        let keys: Vec<u32> = (0..10_000_000).map(|_| rng.random()).collect();
        let sort = RadixSort::plan(device.adapter(), keys.len(), 32, 0).make(&device).expect("a sort");
        assert_sorts(&device, &sort, &keys, 32);
    }
}

#[test]
fn a_sort_by_a_number_of_bits_that_it_knows_makes_no_buffers() {
    let device = gpu_with(DeviceSettings::default());
    let mut rng = Pcg64::seed_from_u64(3);
    let keys: Vec<u32> = (0..5000).map(|_| rng.random()).collect();
    let mut sort = RadixSort::plan(device.adapter(), keys.len(), 9, 0).make(&device).expect("a sort");
    for bits in [12, 0, 9] {
        sort.set_bits(&device, bits).expect("room");
    }
    let made = device.buffers_made();
    for bits in [0, 12, 9, 9, 12] {
        sort.set_bits(&device, bits).expect("room");
    }
    assert_eq!(device.buffers_made(), made);
    for bits in [12, 9, 0] {
        sort.set_bits(&device, bits).expect("room");
        assert_sorts(&device, &sort, &keys, bits);
    }
}

#[test]
fn kernels_divide_their_work_as_suits_the_adapter_unless_told() {
    let usual = if gpu().adapter().is_software() { KernelVariant::Software } else { KernelVariant::Hardware };
    assert_eq!(gpu().variant(), usual);
    assert_eq!(variants().map(|device| device.variant()), [KernelVariant::Software, KernelVariant::Hardware]);
}

#[test]
fn subgroups_that_are_narrower_than_a_workgroup_are_found_out() {
    let found = |lanes: u32| {
        let subgroups = Some(Subgroups::AtLeast(lanes));
        gpu_with(DeviceSettings { subgroups, ..DeviceSettings::default() }).subgroups()
    };
    if let Subgroups::Exactly(lanes) = gpu().subgroups() {
        assert_eq!(found(lanes), Subgroups::AtLeast(lanes));
        assert_eq!(found(2 * lanes), Subgroups::Unused);
    }
}

#[test]
fn a_device_that_does_not_answer_in_time_counts_as_hung_from_then_on() {
    let limit = Duration::from_millis(1);
    let device = gpu_with(DeviceSettings { max_wait: Some(limit), ..DeviceSettings::default() });
    let (pairs, spare) = (Pairs::plan(1 << 20).make(&device), Pairs::plan(1 << 20).make(&device));
    let (pairs, spare) = (pairs.expect("room"), spare.expect("room"));
    let counts = device.upload("counts", &[1_u32 << 20]).expect("counts");
    let sort = RadixSort::plan(device.adapter(), 1 << 20, 32, 0).make(&device).expect("a sort");
    let mut recorder = device.recorder("more than fits in a millisecond");
    for _ in 0..10 {
        let _ = sort.record(&mut recorder, &counts, &pairs, &spare);
    }
    recorder.submit().expect("submitted");
    let hung = GpuError::Timeout { waited: limit };
    assert_eq!(device.wait(), Err(hung.clone()));
    assert_eq!(device.check(), Err(hung.clone()));
    device.set_max_wait(Duration::from_secs(600));
    assert_eq!(device.read(&counts), Err(hung.clone()), "it is not asked again");
    assert_eq!(device.buffer::<u32>("more", 1).map(|_| ()), Err(hung));
}

#[test]
fn recorded_writes_take_effect_in_order() {
    let device = gpu();
    let (buffer, copy) = (device.buffer("b", 3).expect("room"), device.buffer("c", 3).expect("room"));
    let mut recorder = device.recorder("writes");
    recorder.write(&buffer, &[1_u32, 2, 3]);
    recorder.copy(&buffer, 0, &copy, 0, 3);
    recorder.write(&buffer, &[7_u32]);
    recorder.write::<u32>(&buffer, &[]);
    recorder.submit().expect("submitted");
    assert_eq!(device.read(&copy).expect("read"), [1, 2, 3]);
    assert_eq!(device.read(&buffer).expect("read"), [7, 2, 3]);
}

#[test]
fn timed_dispatches_are_named_in_order() {
    let device = gpu();
    let scan =
        Scan::plan(device.adapter(), 100, ScanSlots { count: 0, total: 0 }).make(&device).expect("a scan");
    let counts = device.upload("counts", &[100_u32]).expect("counts");
    let (values, sums, totals) = (junk(&device, 100), junk(&device, 100), junk(&device, 1));
    let mut recorder = device.timed_recorder("scan");
    scan.record(&mut recorder, &counts, &values, &sums, &totals);
    let names: Vec<_> = recorder.submit_timed().expect("submitted").iter().map(|time| time.name).collect();
    if device.adapter().timestamps {
        let software = ["scan_reduce", "scan_partials", "scan_apply"];
        let hardware = ["scan_block_sums", "scan_blocks"];
        assert_eq!(names, device.variant().choose(&software[..], &hardware[..]));
    } else {
        assert!(names.is_empty());
    }
    assert_eq!(device.read(&totals).expect("totals"), [u32::MAX]);
}
