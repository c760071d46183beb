//! Random anchors with what networks might say of them, away from every decision that rounding might take differently.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    domain::Lattice,
    gpu::{Buffer, Device},
    model::{AnchorRows, ModelShape, all_offsets},
    render::DeviceAnchors,
    train::context::{
        AnchorSample, Quantization, QuantizationPhase, QuantizedRows, RateInputs, RateTerm, SampleOutputs,
    },
};

/// Sizes that leave every tile of the kernels partly filled.
pub(super) const SMALL: ModelShape = ModelShape::new(8, 3);

/// The sizes that are trained.
pub(super) const USUAL: ModelShape = ModelShape::new(32, 10);

/// Unlike each other, and none a power of two.
pub(super) const BASE_STEPS: [f32; 3] = [0.7, 0.013, 0.21];

pub(super) const LAMBDA: f64 = 3.0;

pub(super) fn quantization(phase: QuantizationPhase) -> Quantization {
    Quantization { phase, base_quant_steps: BASE_STEPS, key: Quantization::key(11, 4) }
}

pub(super) fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

/// First column of each group in a row, and the end of the last.
pub(super) fn columns(shape: ModelShape) -> [usize; 4] {
    [0, shape.scaling_column(), shape.offset_column(), shape.row()]
}

#[derive(Clone)]
pub(super) struct Case {
    pub(super) anchors: AnchorRows,
    /// `[N][3]`.
    pub(super) steps: Vec<f32>,
    pub(super) sample: Vec<u32>,
    /// By group, then sampled anchor: `2 C + 1` outputs.
    pub(super) outputs: [Vec<Vec<f32>>; 3],
}

impl Case {
    pub(super) fn random(seed: u64, shape: ModelShape, count: usize, sampled: usize) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut case = Self {
            anchors: AnchorRows {
                shape,
                lattice: Lattice { voxel: 1.0, origin: [0.0; 3] },
                cells: (0..count as i32).map(|i| [i, 0, 0]).collect(),
                values: vec![0.0; count * shape.row()],
                masks: (0..count)
                    .map(|_| all_offsets(shape) & (rng.random::<u32>() | rng.random::<u32>()))
                    .collect(),
            },
            steps: (0..3 * count).map(|i| BASE_STEPS[i % 3] * rng.random_range(0.3..3.0_f32)).collect(),
            sample: (0..count as u32).collect(),
            outputs: [const { Vec::new() }; 3],
        };
        // The sample in no order.
        for place in 0..sampled {
            case.sample.swap(place, rng.random_range(place..count));
        }
        case.sample.truncate(sampled);
        for anchor in 0..count {
            let own = [0, 1, 2].map(|group| f64::from(case.steps[3 * anchor + group]));
            let fresh = case.sample.contains(&(anchor as u32));
            for group in 0..3 {
                // Multiples of 1/256, as the decoder has them; some beyond the bounds.
                let adjustment = f64::from(rng.random_range(-1000..1000)) / 256.0;
                let asked = rounded_octaves(adjustment);
                let base = f64::from(BASE_STEPS[group]);
                let channels = columns(shape)[group]..columns(shape)[group + 1];
                let (mut means, mut scales) = (Vec::new(), Vec::new());
                for column in channels {
                    let scale = f64::from(rng.random_range(-1200..2400)) / 256.0;
                    let (value, mean) = loop {
                        let value = base * rng.random_range(0.2..30.0);
                        let value = if group == 1 { value.ln() as f32 } else { value as f32 };
                        let natural = if group == 1 { f64::from(value).exp() } else { f64::from(value) };
                        let from = natural / base + scale.exp2() * rng.random_range(-3.0..3.0);
                        let mean = from as f32;
                        let clamped = adjustment.clamp(-3.5, 3.5).exp2();
                        let apart = |value: f64| (value - value.floor() - 0.5).abs() > 2e-3;
                        let steps = [base, own[group], base * clamped, base * asked.exp2()];
                        if steps
                            .iter()
                            .all(|step| apart(natural / step) && (natural / step - 1.0).abs() > 1e-3)
                            && apart(16.0 * f64::from(mean) / asked.exp2())
                        {
                            break (value, mean);
                        }
                    };
                    case.anchors.values[anchor * shape.row() + column] = value;
                    means.push(mean);
                    scales.push(scale as f32);
                }
                if fresh {
                    let outputs = [means, scales, vec![adjustment as f32]].concat();
                    case.outputs[group].push(outputs);
                }
            }
        }
        // Outputs were made in the anchors' order.
        let mut order: Vec<usize> = (0..sampled).collect();
        order.sort_by_key(|place| case.sample[*place]);
        for outputs in &mut case.outputs {
            let mut by_place = vec![Vec::new(); sampled];
            for (place, values) in order.iter().zip(outputs.drain(..)) {
                by_place[*place] = values;
            }
            *outputs = by_place;
        }
        case
    }

    pub(super) fn shape(&self) -> ModelShape {
        self.anchors.shape
    }

    pub(super) fn own_steps(&self, anchor: usize) -> [f64; 3] {
        [0, 1, 2].map(|group| f64::from(self.steps[3 * anchor + group]))
    }
}

/// Octaves of the step that the decoder takes for an adjustment.
pub(super) fn rounded_octaves(adjustment: f64) -> f64 {
    let q8 = (adjustment.clamp(-3.5, 3.5) * 256.0 + 0.5).floor() as i64;
    ((q8 * 1170 + (1 << 15)) >> 16).clamp(-16, 16) as f64 * 7.0 / 32.0
}

/// A case on the device.
pub(super) struct OnDevice {
    pub(super) anchors: DeviceAnchors,
    pub(super) quantized: QuantizedRows,
    pub(super) list: Buffer<u32>,
    pub(super) count: usize,
    pub(super) outputs: Buffer<f32>,
    pub(super) d_outputs: Buffer<f32>,
    first_rows: [usize; 3],
    pub(super) d_rows: Buffer<f32>,
    pub(super) rate: RateTerm,
    pub(super) overflow_flag: Buffer<u32>,
    room: usize,
}

/// What every fresh buffer holds, so that a value that is not written shows.
pub(super) const JUNK: f32 = 1234.5;

/// Rows of nothing before a group's.
const GAP: usize = 2;

impl OnDevice {
    /// `d_rendered` are the gradients by the rendered rows.
    pub(super) fn upload(device: &Device, case: &Case, d_rendered: &[f32]) -> Self {
        let (shape, count) = (case.shape(), case.sample.len());
        let room = count + 5;
        let list = [vec![count as u32], case.sample.clone(), vec![u32::MAX; 5]].concat();
        let mut first_rows = [0; 3];
        let mut outputs = Vec::new();
        for (of_group, first_row) in case.outputs.iter().zip(&mut first_rows) {
            *first_row = outputs.len() / room + GAP;
            let rows = of_group.first().map_or(0, Vec::len);
            outputs.resize((*first_row + rows) * room, JUNK);
            for (place, of_anchor) in of_group.iter().enumerate() {
                for (row, value) in of_anchor.iter().enumerate() {
                    outputs[(*first_row + row) * room + place] = *value;
                }
            }
        }
        let junk = |len: usize| device.upload("junk", &vec![JUNK; len]).expect("room");
        Self {
            anchors: DeviceAnchors::upload(device, &case.anchors, &[]).expect("anchors"),
            quantized: QuantizedRows::upload(device, shape, &case.steps).expect("room"),
            list: device.upload("list", &list).expect("room"),
            count,
            d_outputs: junk(outputs.len()),
            outputs: device.upload("outputs", &outputs).expect("room"),
            first_rows,
            d_rows: device.upload("gradients", d_rendered).expect("room"),
            rate: RateTerm::plan(shape, room + 3).make(device).expect("the kernels"),
            overflow_flag: device.buffer("overflow flag", 1).expect("room"),
            room,
        }
    }

    pub(super) fn sample(&self) -> AnchorSample<'_> {
        AnchorSample { list: &self.list, count: self.count, capacity: self.room }
    }

    /// Rendering's way back, then the rate.
    pub(super) fn run(&self, device: &Device, quantization: &Quantization) {
        let mut recorder = device.recorder("rate");
        self.quantized
            .record_backward(&mut recorder, &self.anchors, quantization, &self.d_rows)
            .expect("recorded");
        let outputs =
            SampleOutputs { values: &self.outputs, gradients: &self.d_outputs, first_rows: self.first_rows };
        let inputs = RateInputs {
            anchors: &self.anchors,
            quantized: &self.quantized,
            quantization,
            sample: self.sample(),
            outputs,
            lambda: LAMBDA,
        };
        self.rate.record(&mut recorder, &inputs, &self.d_rows, &self.overflow_flag).expect("recorded");
        recorder.submit().expect("submitted");
    }

    /// Gradients by a group's outputs, by sampled anchor.
    pub(super) fn output_gradients(&self, device: &Device, group: usize) -> Vec<Vec<f64>> {
        let values = device.read(&self.d_outputs).expect("read");
        let first_row = self.first_rows[group];
        let next = self.first_rows.get(group + 1).map_or(values.len() / self.room, |next| next - GAP);
        let gap = (first_row - GAP) * self.room..first_row * self.room;
        assert!(values[gap].iter().all(|v| *v == JUNK), "other rows are left alone");
        (0..self.count)
            .map(|place| (first_row..next).map(|row| f64::from(values[row * self.room + place])).collect())
            .collect()
    }

    /// Bits of an offset of a sampled anchor, or of a group: by row, then sampled anchor.
    pub(super) fn bits(&self, device: &Device) -> Vec<Vec<f64>> {
        let values = device.read(self.rate.bits()).expect("read");
        values.chunks(self.rate.capacity()).map(|row| f64s(&row[..self.count])).collect()
    }
}

/// Random gradients, one a value of a row.
pub(super) fn random_gradients(seed: u64, len: usize) -> Vec<f32> {
    let mut rng = Pcg64::seed_from_u64(seed);
    (0..len).map(|_| rng.random_range(-0.02..0.02_f32)).collect()
}
