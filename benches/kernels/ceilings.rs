//! Peak rates of the adapter: small kernels that only copy, only read at random, or only compute. The stages' figures are shares
//! of these.

use std::{sync::Arc, time::Duration};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::gpu::{Binding, Device, KernelSource, KernelVariant};

/// Runs of each probe, of which the fastest counts.
const RUNS: usize = 40;

/// How large the probes are.
#[derive(Debug, Clone, Copy)]
struct Extent {
    /// Floats in each buffer.
    floats: usize,
    /// Workgroups of 64, each invocation of which has a place for four floats.
    groups: u32,
}

impl Extent {
    /// On a CPU, buffers hold more than what is private to a core, and few enough floats that a run is as short as a kernel of a
    /// step, since what disturbs long runs must not lower the ceiling of short ones. On a GPU they have to be larger than its
    /// last cache, some 50 to 100 MB, and workgroups more than fill it.
    fn of(device: &Device) -> Self {
        let (floats, groups) = match device.variant() {
            KernelVariant::Software => (2 << 20, 512),
            KernelVariant::Hardware => (64 << 20, 16_384),
        };
        let adapter = device.adapter();
        let bindable = adapter.max_binding_bytes.min(adapter.max_buffer_bytes) as usize / size_of::<f32>();
        let floats = floats.min(bindable);
        Self { floats, groups: groups.min((floats / (4 * 64)) as u32) }
    }
}

/// Floating-point operations of an invocation of `multiply_add.wgsl`: turns, steps, chains, and two operations each.
const OPERATIONS: f64 = 16.0 * 16.0 * 16.0 * 2.0;

macro_rules! probe {
    ($name:literal) => {
        KernelSource { name: $name, text: include_str!(concat!("probes/", $name, ".wgsl")) }
    };
}

/// Measured rates of an adapter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ceilings {
    /// Bytes a second of a copy, read and written both counted.
    pub(crate) copy: f64,
    /// Bytes a second of reads of single floats at random places.
    pub(crate) gather: f64,
    /// Multiplications and additions a second.
    pub(crate) arithmetic: f64,
}

impl Ceilings {
    pub(crate) fn measure(device: &Arc<Device>) -> Self {
        let Extent { floats, groups } = Extent::of(device);
        let mut rng = Pcg64::seed_from_u64(1);
        let from = device.upload("from", &vec![1.0_f32; floats]).unwrap();
        let to = device.buffer::<f32>("to", floats).unwrap();
        let places: Vec<u32> = (0..floats).map(|_| rng.random_range(0..floats as u32)).collect();
        let places = device.upload("places", &places).unwrap();
        let seeds = device.upload("seeds", &[[0.5_f32; 4], [0.25; 4], [1.0; 4]]).unwrap();
        let seconds = |source: KernelSource, bindings: &[Binding<'_>]| {
            let kernel = device.kernel(source, &[]).unwrap();
            let time = (0..RUNS).map(|_| {
                let mut recorder = device.timed_recorder("probe");
                recorder.dispatch(&kernel, bindings, groups);
                recorder.submit_timed().unwrap().iter().map(|kernel| kernel.time).sum::<Duration>()
            });
            time.min().unwrap_or_default().as_secs_f64()
        };
        let bytes = (floats * size_of::<f32>()) as f64;
        let invocations = f64::from(64 * groups);
        Self {
            copy: 2.0 * bytes / seconds(probe!("streaming_copy"), &[&from, &to]),
            gather: bytes / seconds(probe!("random_reads"), &[&places, &from, &to]),
            arithmetic: OPERATIONS * invocations / seconds(probe!("multiply_add"), &[&seeds, &to]),
        }
    }
}
