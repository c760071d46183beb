//! What the adapter can do at best: small kernels that only copy, only read at random, or only compute. The stages'
//! figures are stated as shares of these.

use std::{sync::Arc, time::Duration};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::gpu::{Binding, Context, KernelSource};

/// Of each probe the fastest of this many runs.
const RUNS: usize = 40;

/// Floats in the buffers of the probes: more than what is private to a core, and few enough that a run is as short as a
/// kernel of a step, since what disturbs long runs must not lower the ceiling of short ones.
const FLOATS: usize = 2 << 20;

/// Workgroups of the probes.
const GROUPS: u32 = 512;

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
    pub(crate) fn measure(context: &Arc<Context>) -> Self {
        let mut rng = Pcg64::seed_from_u64(1);
        let from = context.upload("from", &vec![1.0_f32; FLOATS]).unwrap();
        let to = context.buffer::<f32>("to", FLOATS).unwrap();
        let places: Vec<u32> = (0..FLOATS).map(|_| rng.random_range(0..FLOATS as u32)).collect();
        let places = context.upload("places", &places).unwrap();
        let seeds = context.upload("seeds", &[[0.5_f32; 4], [0.25; 4], [1.0; 4]]).unwrap();
        let seconds = |source: KernelSource, bindings: &[Binding<'_>]| {
            let kernel = context.kernel(source, &[]).unwrap();
            let time = (0..RUNS).map(|_| {
                let mut recorder = context.timed_recorder("probe");
                recorder.dispatch(&kernel, bindings, GROUPS);
                recorder.submit_timed().unwrap().iter().map(|kernel| kernel.time).sum::<Duration>()
            });
            time.min().unwrap_or_default().as_secs_f64()
        };
        let bytes = (FLOATS * size_of::<f32>()) as f64;
        let invocations = f64::from(64 * GROUPS);
        Self {
            copy: 2.0 * bytes / seconds(probe!("streaming_copy"), &[from.as_ref(), to.as_ref()]),
            gather: bytes / seconds(probe!("random_reads"), &[places.as_ref(), from.as_ref(), to.as_ref()]),
            arithmetic: OPERATIONS * invocations
                / seconds(probe!("multiply_add"), &[seeds.as_ref(), to.as_ref()]),
        }
    }
}
