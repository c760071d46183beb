//! Which part of the work a workgroup does: `shaders/shared/permute.wgsl`.

/// Which of `count` parts of the work a workgroup does on a software adapter (`shaders/shared/permute.wgsl`): parts in order, dealt out
/// alternately four times.
#[must_use]
pub fn part_of(workgroup: u32, count: u32) -> u32 {
    let half = count.div_ceil(2);
    (0..4).fold(workgroup, |part, _| if part < half { 2 * part } else { 2 * (part - half) + 1 })
}

#[cfg(test)]
mod tests {
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
            #import tcgs::permute::part_of
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
}
