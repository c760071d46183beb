//! Adam on the device (METHOD.md §2.5).

use std::sync::Arc;

use crate::gpu::{Buffer, Device, GpuError, Kernel, Plan, Recorder, kernel_source, planned};

const BETAS: [f64; 2] = [0.9, 0.999];
const EPSILON: f32 = 1e-15;

/// First and second moments of an array of parameters.
#[derive(Debug)]
pub struct Moments {
    /// Running mean of the gradient.
    pub first: Buffer<f32>,
    /// Running mean of its square.
    pub second: Buffer<f32>,
}

impl Moments {
    /// Plans zero moments of `len` parameters.
    #[must_use]
    pub fn plan(len: usize) -> Plan<'static, Self> {
        planned!(Self {
            first: Plan::buffer("first moments", len),
            second: Plan::buffer("second moments", len),
        })
    }

    /// Uploads moments from the host.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn upload(device: &Device, first: &[f32], second: &[f32]) -> Result<Self, GpuError> {
        let made = Self::plan(first.len()).make(device)?;
        device.write(&made.first, first);
        device.write(&made.second, second);
        Ok(made)
    }
}

/// The optimiser's kernel.
#[derive(Debug)]
pub struct Adam {
    kernel: Arc<Kernel>,
}

impl Adam {
    /// Prepares the kernel.
    ///
    /// # Errors
    /// Faults of the device.
    pub fn new(device: &Device) -> Result<Self, GpuError> {
        Ok(Self { kernel: device.kernel(kernel_source!("adam"), &[])? })
    }

    /// Records step `t` (from 1), which does nothing if `overflow_flag` is set by then. Element i learns at
    /// `rates[i % rates.len()]`.
    ///
    /// # Errors
    /// Faults of the device.
    #[expect(clippy::too_many_arguments, reason = "one dispatch's worth of buffers, named at each call")]
    pub fn step(
        &self,
        recorder: &mut Recorder<'_>,
        t: u32,
        overflow_flag: &Buffer<u32>,
        rates: &Buffer<f32>,
        gradients: &Buffer<f32>,
        values: &Buffer<f32>,
        moments: &Moments,
    ) -> Result<(), GpuError> {
        let powers = BETAS.map(|beta| 1.0 - beta.powi(i32::try_from(t).unwrap_or(i32::MAX)));
        let uniform = recorder.uniform(&[
            [f32::from_bits(values.len() as u32), f32::from_bits(rates.len() as u32), 0.0, 0.0],
            [BETAS[0] as f32, BETAS[1] as f32, (1.0 / powers[0]) as f32, (1.0 / powers[1].sqrt()) as f32],
            // Not from the rounded betas: 1 - 0.999 in f32 is wrong by one part in 80 000.
            [EPSILON, (1.0 - BETAS[0]) as f32, (1.0 - BETAS[1]) as f32, 0.0],
        ])?;
        recorder.dispatch(
            &self.kernel,
            &[
                uniform.as_ref(),
                rates.as_ref(),
                gradients.as_ref(),
                values.as_ref(),
                moments.first.as_ref(),
                moments.second.as_ref(),
                overflow_flag.as_ref(),
            ],
            values.len().div_ceil(4 * 64) as u32,
        );
        Ok(())
    }
}
