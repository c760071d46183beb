//! The shaders' tests for NaN and infinity.

use tcgs_render::gpu::KernelSource;

use crate::support::gpu::gpu;

#[test]
fn shaders_know_numbers_that_are_none_and_magnitudes_by_their_bits() {
    let values = [
        0.0,
        -0.0,
        1.0,
        -1.0,
        f32::MIN_POSITIVE,
        1e15,
        -1e18,
        9.999_999e29,
        1e30,
        -1e30,
        f32::MAX,
        f32::MIN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::NAN,
        -f32::NAN,
        f32::from_bits(0x7f80_0001),
        f32::from_bits(0xffff_ffff),
    ];
    let rows: Vec<[f32; 2]> = [1.0_f32, 1e15, 1e18, 1e30]
        .into_iter()
        .flat_map(|limit| values.map(|value| [value, limit]))
        .collect();
    let device = gpu();
    let source = KernelSource { name: "finite_probe", text: include_str!("finite_probe.wgsl") };
    let kernel = device.kernel(source, &[]).expect("the probe");
    let given = device.upload("rows", &rows).expect("room");
    let found = device.buffer::<[u32; 4]>("found", rows.len()).expect("room");
    let mut recorder = device.recorder("probe");
    recorder.dispatch(&kernel, &[&given, &found], rows.len().div_ceil(64) as u32);
    recorder.submit().expect("submitted");
    for ([value, limit], found) in rows.iter().zip(device.read(&found).expect("read")) {
        let (finite, below) = (u32::from(value.is_finite()), u32::from(value.abs() < *limit));
        assert_eq!(
            found,
            [finite, finite, below, below],
            "{value:e} ({:x}) below {limit:e}",
            value.to_bits()
        );
    }
}
