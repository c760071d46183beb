//! Adam on the device (METHOD.md §2.5).

use std::sync::Arc;

use crate::gpu::{Buffer, Device, GpuError, Kernel, Plan, Recorder, kernel_source, planned};

pub(super) const BETAS: [f64; 2] = [0.9, 0.999];
pub(super) const EPSILON: f32 = 1e-15;

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
    pub fn upload(device: &Device, first: &[f32], second: &[f32]) -> Result<Self, GpuError> {
        let made = Self::plan(first.len()).make(device)?;
        device.write(&made.first, first);
        device.write(&made.second, second);
        Ok(made)
    }
}

/// One step of the optimizer.
#[derive(Debug, Clone, Copy)]
pub struct AdamStep<'a> {
    /// From 1.
    pub number: u32,
    /// Set on the device if the step has to be repeated; it then changes nothing.
    pub overflow_flag: &'a Buffer<u32>,
}

/// The optimizer's kernel.
#[derive(Debug)]
pub struct Adam {
    kernel: Arc<Kernel>,
}

impl Adam {
    /// Prepares the kernel.
    pub fn new(device: &Device) -> Result<Self, GpuError> {
        Ok(Self { kernel: device.kernel(kernel_source!("adam"), &[])? })
    }

    /// Records a step. Element i learns at `learning_rates[i % learning_rates.len()]`.
    pub fn step(
        &self,
        recorder: &mut Recorder<'_>,
        step: AdamStep<'_>,
        learning_rates: &Buffer<f32>,
        gradients: &Buffer<f32>,
        values: &Buffer<f32>,
        moments: &Moments,
    ) -> Result<(), GpuError> {
        let powers = BETAS.map(|beta| 1.0 - beta.powi(i32::try_from(step.number).unwrap_or(i32::MAX)));
        let uniform = recorder.uniform(&[
            [f32::from_bits(values.len() as u32), f32::from_bits(learning_rates.len() as u32), 0.0, 0.0],
            [BETAS[0] as f32, BETAS[1] as f32, (1.0 / powers[0]) as f32, (1.0 / powers[1].sqrt()) as f32],
            // Not from the rounded betas: 1 - 0.999 in f32 is wrong by one part in 80 000.
            [EPSILON, (1.0 - BETAS[0]) as f32, (1.0 - BETAS[1]) as f32, 0.0],
        ])?;
        recorder.dispatch(
            &self.kernel,
            &[
                &uniform,
                learning_rates,
                gradients,
                values,
                &moments.first,
                &moments.second,
                step.overflow_flag,
            ],
            values.len().div_ceil(4 * 64) as u32,
        );
        Ok(())
    }
}
