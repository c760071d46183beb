//! Fits the quantization steps of a scene to a target size, before everything is rounded.
//!
//! From there on the weight of the rate hardly changes the size, and steps that become coarser do: training compensates for what they
//! cost, which it cannot do for what is removed from the finished scene. Sizes are those of real files, since estimates know nothing
//! of what the encoder saves by regressions.

use super::context_fit::{ContextFit, candidates_of};
use crate::{
    codec::{ContextSearch, ContextSettings, EncodeSettings, Provenance, encode},
    domain::{AnchorScene, Background, context_model::STEP_OCTAVES},
    model::NetworkLayout,
    train::{
        Result, SizeLimit, TrainError,
        context::{ContextLayout, ContextNet},
    },
};

/// Files that are coded on the way, beside those at both ends of the octaves.
const ATTEMPTS: u32 = 4;

/// The share of the limit from which a file is close enough.
const CLOSE: f64 = 0.996;

/// Bytes of a file's manifest and tables, which say more than those that are coded here.
const CONTAINER_BYTES: u64 = 820;

impl ContextFit<'_> {
    /// Changes all anchors' quantization steps, and what the model predicts of them, by the octaves with which the file comes closest
    /// to the bytes of `limit` without exceeding them; by none if it cannot be coded.
    ///
    /// # Errors
    /// Cancellation before the next file; errors of the device.
    pub(super) fn within(&self, net: ContextNet, limit: &SizeLimit) -> Result<ContextNet> {
        let (device, quant) = (&self.compression.device, self.quant);
        let attempt = Attempt {
            fit: self,
            scene: self.rows.to_scene(
                NetworkLayout::new(self.rows.shape).to_networks(&device.read(&self.anchors.networks)?),
            ),
            steps: device.read(quant.rows.steps())?,
            values: net.save()?.values,
            layout: net.layout(),
        };
        let mut bytes_at = |octaves| if self.cancel.is_cancelled() { None } else { attempt.bytes(octaves) };
        let octaves = closest(limit, &mut bytes_at);
        if self.cancel.is_cancelled() {
            return Err(TrainError::Cancelled);
        }
        let Some(octaves) = octaves else { return Ok(net) };
        if octaves == 0.0 {
            return Ok(net);
        }
        device.write(quant.rows.steps(), &coarser(&attempt.steps, quant.base, octaves));
        let mut values = attempt.values;
        shift_adjustments(net.layout(), octaves, &mut values);
        self.model(net.layout().config, values)
    }
}

/// The scene as it is, to be coded with coarser steps.
struct Attempt<'a> {
    fit: &'a ContextFit<'a>,
    scene: AnchorScene,
    steps: Vec<f32>,
    values: Vec<f32>,
    layout: &'a ContextLayout,
}

impl Attempt<'_> {
    /// Bytes of the file with steps `octaves` coarser; none if it cannot be coded so.
    fn bytes(&self, octaves: f32) -> Option<f64> {
        let Self { fit, scene, steps, values, layout } = self;
        let base = fit.quant.base_quant_steps;
        let mut values = values.clone();
        shift_adjustments(layout, octaves, &mut values);
        let steps = coarser(steps, fit.quant.base, octaves);
        let frame = fit.context_model.frame;
        let candidates = candidates_of(layout, &values, frame, (&steps, fit.quant.base));
        let regression = fit.compression.schedule.regression;
        let settings = EncodeSettings {
            background: Background::Black,
            feature_step: base.feature,
            scaling_step: base.scaling,
            offset_step: base.offset,
            context: ContextSettings { search: ContextSearch::Cheapest, regression, coarser: [0; 3] },
            provenance: Provenance::unstated(),
        };
        let counts = encode(scene, Some(&candidates), &settings)
            .inspect_err(|error| tracing::debug!(octaves, "the scene cannot be coded: {error}"))
            .ok()?
            .byte_counts;
        let bytes = counts.total + CONTAINER_BYTES.saturating_sub(counts.container);
        tracing::debug!(octaves, bytes, "a file with other quantization steps");
        Some(bytes as f64)
    }
}

/// The octaves with which a file comes closest to the bytes of `limit` without exceeding them, or else comes closest to them from above;
/// none if a file cannot be coded.
fn closest(limit: &SizeLimit, bytes_at: &mut dyn FnMut(f32) -> Option<f64>) -> Option<f32> {
    let (start, end) = (*limit.octaves.start(), *limit.octaves.end());
    let mut above = (start, bytes_at(start)?);
    if above.1 <= limit.bytes {
        return Some(start);
    }
    let mut within = (end, bytes_at(end)?);
    if within.1 > limit.bytes {
        return Some(end);
    }
    for _ in 0..ATTEMPTS {
        if within.1 >= CLOSE * limit.bytes {
            break;
        }
        // Files shrink by about the same share an octave.
        let wanted = (0.5 * (1.0 + CLOSE) * limit.bytes).ln();
        let share = (above.1.ln() - wanted) / (above.1.ln() - within.1.ln());
        let octaves = above.0 + share.clamp(0.02, 0.98) as f32 * (within.0 - above.0);
        let bytes = bytes_at(octaves)?;
        if bytes <= limit.bytes { within = (octaves, bytes) } else { above = (octaves, bytes) }
    }
    Some(within.0)
}

/// Steps `octaves` coarser, within their range from the base steps; `[N][3]`.
fn coarser(steps: &[f32], base: [f32; 3], octaves: f32) -> Vec<f32> {
    let max = STEP_OCTAVES.exp2();
    let factor = octaves.exp2();
    let of_group = steps.iter().zip(base.into_iter().cycle());
    of_group.map(|(step, base)| (step * factor).clamp(base / max, base * max)).collect()
}

/// Adds to the step adjustments that networks predict. A group's adjustment is its last output.
fn shift_adjustments(layout: &ContextLayout, octaves: f32, values: &mut [f32]) {
    for head in &layout.heads {
        values[head.bias + head.outputs - 1] += octaves;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_become_coarser_within_their_range() {
        let found = coarser(&[1.0, 0.5, 2.0, 8.0, 0.1, 1.0], [1.0, 0.5, 2.0], 1.0);
        assert_eq!(found, [2.0, 1.0, 4.0, STEP_OCTAVES.exp2(), 0.2, 2.0]);
        let found = coarser(&[1.0, 0.5, 2.0], [1.0, 0.5, 2.0], -0.5);
        assert!(found.iter().zip([0.707, 0.3535, 1.414]).all(|(a, b)| (a - b).abs() < 1e-3), "{found:?}");
        let found = coarser(&[0.09, 0.5, 2.0], [1.0, 0.5, 2.0], -0.5);
        assert_eq!(found[0], STEP_OCTAVES.exp2().recip());
    }

    #[test]
    fn the_closest_file_is_found_in_few_attempts_and_never_exceeds_the_limit() {
        for slope in [0.1, 0.25, 0.5] {
            for bend in [0.0, 0.1, -0.05] {
                for bytes in [95_000.0, 80_000.0, 71_234.0] {
                    let mut files = 0;
                    let mut bytes_at = |octaves: f32| {
                        files += 1;
                        let octaves = f64::from(octaves);
                        Some((1e5 * (-slope * octaves + bend * octaves * octaves / 3.0).exp()).round())
                    };
                    let limit = SizeLimit { bytes, octaves: -0.5..=1.5 };
                    let octaves = closest(&limit, &mut bytes_at).expect("files");
                    let (found, min) = (bytes_at(octaves).expect("a file"), bytes_at(1.5).expect("a file"));
                    assert!(files <= 2 + ATTEMPTS + 2, "{files}");
                    if min > bytes {
                        assert_eq!(octaves, 1.5, "what is out of reach is approached");
                    } else {
                        assert!((0.99 * bytes..=bytes).contains(&found), "{slope} {bend} {bytes}: {found}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_file_that_fits_as_it_is_keeps_its_steps_and_one_that_cannot_be_coded_too() {
        let limit = SizeLimit { bytes: 1000.0, octaves: 0.0..=1.5 };
        assert_eq!(closest(&limit, &mut |_| Some(1000.0)), Some(0.0));
        assert_eq!(closest(&limit, &mut |_| None), None);
        assert_eq!(closest(&limit, &mut |octaves| (octaves < 1.0).then_some(2000.0)), None);
    }
}
