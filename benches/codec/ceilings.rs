//! What the processor can do at best, on as many threads as the codec has: a plain copy, and plain products of 16-bit
//! integers summed in 32 bits, which is the arithmetic of the context networks.

use std::{hint::black_box, time::Instant};

use rayon::prelude::*;

/// Of each probe the fastest of this many runs.
const RUNS: usize = 10;

/// Bytes of the copy: more than any cache here.
const COPY: usize = 256 << 20;

/// Length of a product's vectors, which stay in the first cache.
const LENGTH: usize = 512;

/// Products a thread computes.
const TURNS: usize = 200_000;

/// Measured rates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ceilings {
    /// Bytes a second of a copy, read and written both counted.
    pub(crate) copy: f64,
    /// Multiplications and additions a second.
    pub(crate) arithmetic: f64,
}

impl Ceilings {
    pub(crate) fn measure() -> Self {
        let threads = rayon::current_num_threads();
        let from = vec![1_u8; COPY];
        let mut to = vec![0_u8; COPY];
        let copy = least(|| {
            let share = COPY.div_ceil(threads);
            to.par_chunks_mut(share)
                .zip(from.par_chunks(share))
                .for_each(|(to, from)| to.copy_from_slice(from));
            black_box(&to);
        });
        let arithmetic = least(|| {
            (0..threads).into_par_iter().for_each(|thread| {
                let mut a = [thread as i16; LENGTH];
                let b = [3_i16; LENGTH];
                for turn in 0..TURNS {
                    a[turn % LENGTH] += 1;
                    black_box(a.iter().zip(&b).map(|(a, b)| i32::from(*a) * i32::from(*b)).sum::<i32>());
                }
            });
        });
        Self {
            copy: 2.0 * COPY as f64 / copy,
            arithmetic: (2 * LENGTH * TURNS * threads) as f64 / arithmetic,
        }
    }
}

/// Seconds of the fastest run.
fn least(mut run: impl FnMut()) -> f64 {
    let seconds = (0..RUNS).map(|_| {
        let start = Instant::now();
        run();
        start.elapsed().as_secs_f64()
    });
    seconds.fold(f64::INFINITY, f64::min)
}
