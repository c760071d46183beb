//! Freezes the anchors' quantization steps while other networks are fitted to predict them.

use std::sync::Arc;

use crate::{
    gpu::{Buffer, Device, GpuError, Kernel, Recorder, kernel_source},
    train::context::{AnchorSample, SampleOutputs},
};

/// The kernels, and the last sample's prediction errors.
#[derive(Debug)]
pub(super) struct FrozenQuantSteps {
    freeze_quant_steps: Arc<Kernel>,
    frozen_quant_step_gradient: Arc<Kernel>,
    differences: Buffer<f32>,
}

impl FrozenQuantSteps {
    /// Room for samples in `capacity` columns.
    pub(super) fn new(device: &Device, capacity: usize) -> Result<Self, GpuError> {
        Ok(Self {
            freeze_quant_steps: device.kernel(kernel_source!("freeze_quant_steps"), &[])?,
            frozen_quant_step_gradient: device.kernel(kernel_source!("frozen_quant_step_gradient"), &[])?,
            differences: device.buffer("differences of steps", 3 * capacity)?,
        })
    }

    /// Records the replacement of the step adjustments in `outputs` by those of `steps`, `[N][3]`.
    pub(super) fn record(
        &self,
        recorder: &mut Recorder<'_>,
        base: [f32; 3],
        steps: &Buffer<f32>,
        sample: AnchorSample<'_>,
        outputs: SampleOutputs<'_>,
        channels: [usize; 3],
    ) -> Result<(), GpuError> {
        let [features, scalings, offsets] = base;
        let settings =
            recorder.uniform(&[[features, scalings, offsets, 0.0], rows(sample, outputs, channels)])?;
        recorder.dispatch(
            &self.freeze_quant_steps,
            &[&settings, sample.list, steps, outputs.values, &self.differences],
            sample.count.div_ceil(64) as u32,
        );
        Ok(())
    }

    /// Records the gradients by the predictions, weighted by group.
    pub(super) fn record_gradient(
        &self,
        recorder: &mut Recorder<'_>,
        weights: [f32; 3],
        sample: AnchorSample<'_>,
        outputs: SampleOutputs<'_>,
        channels: [usize; 3],
    ) -> Result<(), GpuError> {
        let [features, scalings, offsets] = weights;
        let settings =
            recorder.uniform(&[[features, scalings, offsets, 0.0], rows(sample, outputs, channels)])?;
        recorder.dispatch(
            &self.frozen_quant_step_gradient,
            &[&settings, sample.list, &self.differences, outputs.gradients],
            sample.count.div_ceil(64) as u32,
        );
        Ok(())
    }
}

/// The bits of the adjustments' rows and of the columns that there is room for. A group's adjustment is its last output.
fn rows(sample: AnchorSample<'_>, outputs: SampleOutputs<'_>, channels: [usize; 3]) -> [f32; 4] {
    let row = |group: usize| f32::from_bits((outputs.first_rows[group] + 2 * channels[group]) as u32);
    [row(0), row(1), row(2), f32::from_bits(sample.capacity as u32)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        gpu::testing::lavapipe,
        train::twin::{freeze_quant_steps, frozen_quant_step_gradient},
    };

    #[test]
    fn the_kernels_do_as_their_twins() {
        let device = lavapipe();
        // Channels of 2, 1 and 3: rows 5, 3 and 7, of which the last of each is the adjustment.
        let (channels, first_rows, capacity) = ([2, 1, 3], [0, 5, 8], 100);
        let sample: Vec<u32> = (0..70).map(|i| 3 * i).collect();
        let steps: Vec<f32> = (0..3 * 210).map(|i| 0.25 * 1.01_f32.powi(i % 97)).collect();
        let values: Vec<f32> = (0..15 * capacity).map(|i| (i % 31) as f32 / 8.0 - 2.0).collect();
        let base = [0.5, 0.125, 2.0];
        let list: Vec<u32> = std::iter::once(70).chain(sample.iter().copied()).collect();
        let list = device.upload("list", &list).expect("a list");
        let (on_device, outputs) = (
            device.upload("steps", &steps).expect("steps"),
            device.upload("outputs", &values).expect("outputs"),
        );
        let gradients = device.upload("gradients", &vec![9.0_f32; values.len()]).expect("gradients");
        let frozen = FrozenQuantSteps::new(&device, capacity).expect("kernels");
        let sampled = AnchorSample { list: &list, count: 70, capacity };
        let groups = SampleOutputs { values: &outputs, gradients: &gradients, first_rows };
        let weights = [1.0, 0.5, 3.0];
        let mut recorder = device.recorder("frozen steps");
        frozen.record(&mut recorder, base, &on_device, sampled, groups, channels).expect("recorded");
        frozen.record_gradient(&mut recorder, weights, sampled, groups, channels).expect("recorded");
        recorder.submit().expect("runs");
        let found = device.read(&outputs).expect("outputs");
        let d_found = device.read(&gradients).expect("gradients");
        let mut rest = 0;
        for (at, (found, d_found)) in found.iter().zip(&d_found).enumerate() {
            let (row, column) = (at / capacity, at % capacity);
            let group = (0..3).find(|group| first_rows[*group] + 2 * channels[*group] == row);
            let Some(group) = group.filter(|_| column < sample.len()) else {
                assert_eq!((*found, *d_found), (values[at], 9.0));
                rest += 1;
                continue;
            };
            let step = steps[3 * sample[column] as usize + group];
            let (expected, difference) =
                freeze_quant_steps(values[at].into(), step.into(), f64::from(base[group]));
            assert!((f64::from(*found) - expected).abs() < 1e-5, "{found} for {expected}");
            let expected = frozen_quant_step_gradient(difference, f64::from(weights[group]));
            assert!((f64::from(*d_found) - expected).abs() < 3e-5, "{d_found} for {expected}");
        }
        assert_eq!(rest, values.len() - 3 * 70);
    }
}
