//! The anchor model in training: features, scalings and offsets of anchors, and the networks that they share.

use std::sync::Arc;

use rand_pcg::Pcg64;

use super::{
    Adam, CheckpointError, CompressionSchedule, Decay, Densify, MaskRows, Moments, OffsetMasks, Schedule,
    Statistics, TrainError,
    budget::Footprint,
    checkpoint::LearnerState,
    compression::{Compression, compression_bytes},
    densify::{Trainable, densify, drop_masked},
    model_trainer::{Finished, Learner, SampleRate, Size, Step},
    prune_invisible::mask_unused,
};
use crate::{
    domain::{AnchorScene, Camera, CancelFlag, DistanceUnit, Frame, Lattice, NearPlane, Scene},
    gpu::{AdapterReport, Buffer, Device, Recorder, buffer_bytes},
    model::{AnchorRows, MAX_CELL, NetworkLayout, Shape, initial_rows},
    render::{AnchorGradients, DeviceAnchors, GaussianGradients, Gaussians, NeuralGaussians},
};

/// Coarsest growth cell in lattice cells.
const COARSEST_GROWTH: i32 = 16;

/// What of a file does not depend on the rate term, about: an anchor's position and mask, a parameter of the render
/// networks, and the container.
const BYTES_AN_ANCHOR: f64 = 1.6;
const BYTES_A_PARAMETER: f64 = 0.85;
const OTHER_BYTES: f64 = 600.0;

/// Anchors, networks, and what their optimiser and their growth remember.
pub(super) struct AnchorLearner {
    device: Arc<Device>,
    schedule: Schedule,
    shape: Shape,
    extent: f32,
    layout: NetworkLayout,
    owners: Vec<u8>,
    anchors: AnchorRows,
    device_anchors: DeviceAnchors,
    gradients: AnchorGradients,
    row_moments: Moments,
    network_moments: Moments,
    statistics: Buffer<f32>,
    /// Until they are settled.
    masks: Option<OffsetMasks>,
    /// None in the baseline.
    compression: Option<Compression>,
    /// What the last forward pass rendered, where that is not the anchors as they are.
    shown: Option<DeviceAnchors>,
    neural: NeuralGaussians,
    adam: Adam,
}

/// What differs between a learner that begins and one that goes on.
struct Parts {
    state: Trainable,
    statistics: Statistics,
    /// The networks' parameters and their moments.
    networks: [Vec<f32>; 3],
    compression: Option<Compression>,
    unit: DistanceUnit,
}

fn lattice_values(values: &[f32]) -> Result<[f32; 4], CheckpointError> {
    match <[f32; 4]>::try_from(values) {
        Ok(values) if values[0] > 0.0 && values.iter().all(|v| v.is_finite()) => Ok(values),
        _ => Err(CheckpointError::array("lattice", "is not a size and an origin")),
    }
}

/// The usual one where a state has none.
fn unit_of(state: &mut LearnerState) -> Result<DistanceUnit, CheckpointError> {
    if !state.has("unit") {
        return Ok(DistanceUnit::USUAL);
    }
    let unit = state.take_exactly::<f32>("unit", 1)?.first().and_then(|length| DistanceUnit::new(*length));
    unit.ok_or_else(|| CheckpointError::array("unit", "is no length that distances can be told in"))
}

impl AnchorLearner {
    /// Anchors at `points` and fresh networks, which are told distances in `unit`; `extent` is the scene's, in world units.
    pub(super) fn begin(
        device: &Arc<Device>,
        schedule: Schedule,
        points: &[[f32; 3]],
        extent: f32,
        unit: DistanceUnit,
        rng: &mut Pcg64,
    ) -> Result<Self, TrainError> {
        let shape = schedule.shape;
        let rule = schedule.voxel.for_points(points, extent);
        // Growth needs room above what the points begin with.
        let anchors = initial_rows(points, rule, shape, schedule.max_anchors / 2)?;
        let networks = NetworkLayout::new(shape).initial(rng);
        let parameters = networks.len();
        let zeros = |len| vec![0.0; len];
        let compression = schedule.compression.clone();
        let parts = Parts {
            unit,
            networks: [networks, zeros(parameters), zeros(parameters)],
            compression: compression.map(|schedule| Compression::begin(device, schedule, shape)),
            statistics: Statistics::zero(shape, anchors.len()),
            state: Trainable {
                first: zeros(anchors.values.len()),
                second: zeros(anchors.values.len()),
                masks: schedule.masks.map(|_| MaskRows::new(anchors.len() * shape.offsets)),
                anchors,
            },
        };
        Self::assemble(device, schedule, extent, parts)
    }

    /// The learner that [`Learner::save`] was asked of.
    pub(super) fn resume(
        device: &Arc<Device>,
        schedule: Schedule,
        extent: f32,
        mut state: LearnerState,
    ) -> Result<Self, TrainError> {
        let shape = schedule.shape;
        let [voxel, origin @ ..] = lattice_values(&state.take_exactly::<f32>("lattice", 4)?)?;
        let flat: Vec<i32> = state.take("anchors.cells")?;
        let cells: Vec<[i32; 3]> = flat.as_chunks().0.to_vec();
        let anchors = cells.len();
        if anchors == 0
            || flat.len() != 3 * anchors
            || flat.iter().any(|c| c.unsigned_abs() > MAX_CELL as u32)
        {
            let fault = format!("has {} values, or some that are no cell of a lattice", flat.len());
            return Err(CheckpointError::array("anchors.cells", fault).into());
        }
        let rows = anchors * shape.row();
        let offsets = anchors * shape.offsets;
        let parameters = NetworkLayout::new(shape).parameters;
        let unit = unit_of(&mut state)?;
        let masks = state.take_exactly("anchors.masks", anchors)?;
        let learning = state.has("masks.logits");
        let mut floats = |name: &str, len: usize| state.take_exactly::<f32>(name, len);
        let mut parts = Parts {
            unit,
            compression: None,
            statistics: Statistics { shape, values: floats("growth", anchors * Statistics::width(shape))? },
            networks: [
                floats("networks", parameters)?,
                floats("networks.first", parameters)?,
                floats("networks.second", parameters)?,
            ],
            state: Trainable {
                first: floats("anchors.rows.first", rows)?,
                second: floats("anchors.rows.second", rows)?,
                masks: if learning {
                    Some(MaskRows {
                        logits: floats("masks.logits", offsets)?,
                        first: floats("masks.logits.first", offsets)?,
                        second: floats("masks.logits.second", offsets)?,
                    })
                } else {
                    None
                },
                anchors: AnchorRows {
                    shape,
                    lattice: Lattice { voxel, origin },
                    cells,
                    values: floats("anchors.rows", rows)?,
                    masks,
                },
            },
        };
        if let Some(schedule) = &schedule.compression {
            let anchors = &parts.state.anchors;
            parts.compression = Some(Compression::resume(device, schedule.clone(), anchors, &mut state)?);
        }
        state.finish()?;
        Self::assemble(device, schedule, extent, parts)
    }

    fn assemble(
        device: &Arc<Device>,
        schedule: Schedule,
        extent: f32,
        parts: Parts,
    ) -> Result<Self, TrainError> {
        let shape = schedule.shape;
        let Parts { state, statistics, networks: [networks, first, second], compression, unit } = parts;
        let near = NearPlane::of_extent(extent).depth();
        let Trainable { anchors, .. } = &state;
        let masks = state.masks.as_ref().map(|masks| OffsetMasks::upload(device, shape, masks));
        let layout = NetworkLayout::new(shape);
        Ok(Self {
            schedule,
            shape,
            extent,
            owners: layout.owners(),
            device_anchors: DeviceAnchors::upload(device, anchors, &networks)?,
            gradients: AnchorGradients::plan(shape, anchors.len()).make(device)?,
            row_moments: Moments::upload(device, &state.first, &state.second)?,
            network_moments: Moments::upload(device, &first, &second)?,
            statistics: device.upload("growth statistics", &statistics.values)?,
            masks: masks.transpose()?,
            compression,
            shown: None,
            neural: NeuralGaussians::new(Arc::clone(device), shape, near, unit)?,
            adam: Adam::new(device)?,
            device: Arc::clone(device),
            layout,
            anchors: state.anchors,
        })
    }

    fn row_rates(&self, fraction: f64) -> Vec<f32> {
        let mut rates = vec![self.schedule.feature.at(fraction) as f32; self.shape.row()];
        rates[self.shape.scaling_column()..].fill(self.schedule.scaling.at(fraction) as f32);
        rates[self.shape.offset_column()..]
            .fill(self.schedule.offset.at(fraction) as f32 * self.extent / self.neural.unit().length());
        rates
    }

    /// Weight of volumes in world units where the schedule's is of those in the scene's unit.
    fn volume_weight(&self) -> f32 {
        let volume = f64::from(self.neural.unit().length()).powi(3);
        // A weight that is not finite would make NaN of volumes that underflow.
        (f64::from(self.schedule.volume_weight) / volume).min(f64::from(f32::MAX)) as f32
    }

    fn network_rates(&self, fraction: f64) -> Vec<f32> {
        let rates = self.schedule.networks.map(|decay: Decay| decay.at(fraction) as f32);
        self.owners.iter().map(|owner| rates[usize::from(*owner)]).collect()
    }

    fn densify(&mut self, step: u32, rng: &mut Pcg64) -> Result<(), TrainError> {
        let (mut state, mut statistics) = self.read()?;
        let settings = Densify {
            threshold: self.schedule.growth_threshold,
            min_views: 0.4 * self.schedule.densify_every as f32,
            min_visits: 0.8 * self.schedule.densify_every as f32,
            coarsest: COARSEST_GROWTH,
            max_anchors: self.schedule.max_anchors,
            extent: self.extent,
        };
        let outcome = densify(&mut state, &mut statistics, &settings, rng);
        tracing::debug!(step, grown = outcome.grown, pruned = outcome.pruned, anchors = state.anchors.len());
        self.write(state, &statistics, step)
    }

    fn settles_masks(&self, step: u32) -> bool {
        self.schedule.masks.is_some_and(|masks| masks.until == step)
    }

    /// The masks learn no more; anchors that they left without an offset that some view of `frames` shows go.
    fn settle_masks(&mut self, step: u32, frames: &[&Frame], cancel: &CancelFlag) -> Result<(), TrainError> {
        let (mut state, mut statistics) = self.read()?;
        state.masks = None;
        self.mask_unused(step, &mut state.anchors, frames, cancel)?;
        let dropped = drop_masked(&mut state, &mut statistics);
        tracing::debug!(step, dropped, anchors = state.anchors.len(), "masks settled");
        self.write(state, &statistics, step)
    }

    /// Leaves out what no view of `frames` shows any more after `step`: what takes no part in a picture would only cost, in the
    /// file as in the context models that are chosen for it.
    fn drop_unused(&mut self, step: u32, frames: &[&Frame], cancel: &CancelFlag) -> Result<(), TrainError> {
        let (mut state, mut statistics) = self.read()?;
        self.mask_unused(step + 1, &mut state.anchors, frames, cancel)?;
        let dropped = drop_masked(&mut state, &mut statistics);
        tracing::debug!(step, dropped, anchors = state.anchors.len(), "unused anchors left out");
        self.write(state, &statistics, step)
    }

    /// Switches off what no view of `frames` shows of `anchors`, which are those on the device, as rendering sees them at `step`.
    fn mask_unused(
        &mut self,
        step: u32,
        anchors: &mut AnchorRows,
        frames: &[&Frame],
        cancel: &CancelFlag,
    ) -> Result<(), TrainError> {
        if !self.schedule.drops_unused {
            return Ok(());
        }
        let mut recorder = self.device.recorder("what is shown");
        let shown = match &self.compression {
            Some(compression) => compression.forward(&mut recorder, &self.device_anchors, step)?,
            None => None,
        };
        recorder.submit()?;
        let shown = shown.as_ref().unwrap_or(&self.device_anchors);
        mask_unused(&self.device, &mut self.neural, shown, anchors, frames, cancel)
    }

    /// All that belongs to anchors, from the device.
    fn read(&self) -> Result<(Trainable, Statistics), TrainError> {
        let device = &self.device;
        let mut anchors = self.anchors.clone();
        anchors.values = device.read(&self.device_anchors.rows)?;
        anchors.masks = device.read(&self.device_anchors.masks)?;
        let state = Trainable {
            anchors,
            first: device.read(&self.row_moments.first)?,
            second: device.read(&self.row_moments.second)?,
            masks: self.masks.as_ref().map(|masks| masks.read(device)).transpose()?,
        };
        Ok((state, Statistics { shape: self.shape, values: device.read(&self.statistics)? }))
    }

    fn write(&mut self, state: Trainable, statistics: &Statistics, step: u32) -> Result<(), TrainError> {
        if state.anchors.is_empty() {
            return Err(TrainError::NothingLeft { step });
        }
        let device = &self.device;
        let networks = device.read(&self.device_anchors.networks)?;
        self.device_anchors = DeviceAnchors::upload(device, &state.anchors, &networks)?;
        self.row_moments = Moments::upload(device, &state.first, &state.second)?;
        self.gradients = AnchorGradients::plan(self.shape, state.anchors.len()).make(device)?;
        self.statistics = device.upload("growth statistics", &statistics.values)?;
        self.masks = state.masks.map(|masks| OffsetMasks::upload(device, self.shape, &masks)).transpose()?;
        if let Some(compression) = &mut self.compression {
            compression.replace(&self.anchors.cells, &state.anchors)?;
        }
        self.shown = None;
        self.anchors = state.anchors;
        Ok(())
    }
}

/// Host bytes an anchor of the context model's tables while they are made: neighbours, texels and both the other way round,
/// as lists and as they are sorted, and steps by cell.
const CONTEXT_HOST_BYTES: usize = 1024;

/// What anchors take.
#[derive(Debug)]
pub(super) struct AnchorFootprint {
    pub(super) shape: Shape,
    pub(super) max_anchors: usize,
    /// Whether masks learn.
    pub(super) masks: bool,
    /// Compression-aware training; none in the baseline.
    pub(super) compression: Option<CompressionSchedule>,
}

impl Footprint for AnchorFootprint {
    fn unit(&self) -> &'static str {
        "anchors"
    }

    fn most(&self, adapter: &AdapterReport) -> usize {
        self.max_anchors.min(NeuralGaussians::max_anchors(adapter, self.shape))
    }

    /// Rows that a round of growth replaces go one after another, so the largest of them counts twice.
    fn model_bytes(&self, anchors: usize) -> u64 {
        let shape = self.shape;
        let (rows, parameters) = (anchors * shape.row(), NetworkLayout::new(shape).parameters);
        DeviceAnchors::plan(shape, anchors).bytes()
            + AnchorGradients::plan(shape, anchors).bytes()
            + 2 * Moments::plan(rows).bytes()
            + Moments::plan(parameters).bytes()
            + Statistics::bytes(shape, anchors)
            + if self.masks { OffsetMasks::plan(shape, anchors).bytes() } else { 0 }
            + self.compression.as_ref().map_or(0, |schedule| compression_bytes(schedule, shape, anchors))
            + 2 * buffer_bytes::<f32>(shape.row() + parameters)
    }

    fn view_bytes(&self, anchors: usize) -> u64 {
        NeuralGaussians::bytes(self.shape, anchors)
    }

    fn gaussians(&self, anchors: usize) -> usize {
        NeuralGaussians::capacity(anchors).saturating_mul(self.shape.offsets)
    }

    /// A round of growth: rows and moments with the copies that growing vectors make, statistics, and a candidate for each
    /// offset.
    fn host_bytes(&self, anchors: usize) -> u64 {
        let shape = self.shape;
        const CANDIDATE: usize = 2 * size_of::<(usize, [i32; 3], f32)>();
        const CELL: usize = 64;
        let masks = if self.masks { 3 * shape.offsets } else { 0 };
        let row = 6 * (shape.row() + masks) * size_of::<f32>();
        2 * Statistics::bytes(shape, anchors)
            + (anchors * (row + shape.offsets * CANDIDATE + CELL)) as u64
            + if self.compression.is_some() { (anchors * CONTEXT_HOST_BYTES) as u64 } else { 0 }
    }
}

impl Learner for AnchorLearner {
    fn forward(
        &mut self,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        step: &Step,
    ) -> Result<(), TrainError> {
        self.shown = match &self.compression {
            Some(compression) => compression.forward(recorder, &self.device_anchors, step.number)?,
            None => None,
        };
        let shown = self.shown.as_ref().unwrap_or(&self.device_anchors);
        self.neural.forward(recorder, shown, camera, self.volume_weight())?;
        Ok(())
    }

    fn gaussians(&self) -> &Gaussians {
        self.neural.gaussians()
    }

    fn gaussian_gradients(&mut self) -> Result<GaussianGradients, TrainError> {
        Ok(self.neural.gaussian_gradients()?.clone())
    }

    fn backward(
        &mut self,
        recorder: &mut Recorder<'_>,
        _camera: &Camera,
        step: &Step,
        overflow_flag: &Buffer<u32>,
    ) -> Result<(), TrainError> {
        let shown = self.shown.as_ref().unwrap_or(&self.device_anchors);
        self.neural.backward(recorder, shown, &self.gradients)?;
        if self.schedule.gathers_statistics(step.number) {
            self.neural.statistics(recorder, shown, &self.statistics, overflow_flag)?;
        }
        if let Some(compression) = &mut self.compression {
            let d_rows = &self.gradients.rows;
            compression.backward(recorder, &self.adam, &self.device_anchors, step, d_rows, overflow_flag)?;
        }
        let row_rates = recorder.uniform(&self.row_rates(step.fraction))?;
        let network_rates = recorder.uniform(&self.network_rates(step.fraction))?;
        self.adam.step(
            recorder,
            step.number,
            overflow_flag,
            &row_rates,
            &self.gradients.rows,
            &self.device_anchors.rows,
            &self.row_moments,
        )?;
        self.adam.step(
            recorder,
            step.number,
            overflow_flag,
            &network_rates,
            &self.gradients.networks,
            &self.device_anchors.networks,
            &self.network_moments,
        )?;
        if let (Some(masks), Some(schedule)) = (&self.masks, &self.schedule.masks)
            && schedule.learns(step.number)
        {
            masks.backward(
                recorder,
                &mut self.neural,
                &self.device_anchors,
                schedule.weight_at(step.number),
            )?;
            if let Some(compression) = &self.compression {
                compression.mask_backward(recorder, masks, step.lambda)?;
            }
            let rate = schedule.rate.at(step.fraction) as f32;
            let since = step.number + 1 - schedule.from;
            masks.step(
                recorder,
                &self.adam,
                since,
                overflow_flag,
                rate,
                schedule.level,
                &self.device_anchors,
            )?;
        }
        Ok(())
    }

    fn adapts(&self, step: &Step) -> bool {
        let turns = self.compression.as_ref().is_some_and(|compression| compression.turns_after(step.number));
        self.schedule.densifies(step.number) || self.settles_masks(step.number) || turns
    }

    fn adapt(
        &mut self,
        step: &Step,
        rng: &mut Pcg64,
        frames: &[&Frame],
        cancel: &CancelFlag,
    ) -> Result<(), TrainError> {
        if self.schedule.densifies(step.number) {
            self.densify(step.number, rng)?;
        }
        if self.settles_masks(step.number) {
            self.settle_masks(step.number, frames, cancel)?;
        }
        if self.compression.as_ref().is_some_and(|compression| compression.rounds_after(step.number)) {
            self.drop_unused(step.number, frames, cancel)?;
        }
        if self.compression.as_ref().is_some_and(|compression| compression.turns_after(step.number)) {
            let (state, _) = self.read()?;
            if let Some(compression) = &mut self.compression {
                compression.turn(step.number, &self.adam, &state.anchors, &self.device_anchors, cancel)?;
            }
        }
        Ok(())
    }

    fn anchors(&self) -> usize {
        self.anchors.len()
    }

    fn size(&self) -> Result<Size, TrainError> {
        Ok(Size { anchors: self.anchors.len(), gaussians: self.neural.counts()?[1] as usize })
    }

    fn rate(&self) -> Result<Option<SampleRate>, TrainError> {
        let rate = self.compression.as_ref().map(Compression::rate).transpose()?.flatten();
        Ok(rate.map(|(bits_an_anchor, context_bytes)| {
            let anchors = BYTES_AN_ANCHOR * self.anchors.len() as f64;
            let networks = BYTES_A_PARAMETER * self.layout.parameters as f64;
            SampleRate { bits_an_anchor, other_bytes: OTHER_BYTES + anchors + networks + context_bytes }
        }))
    }

    fn save(&self) -> Result<LearnerState, TrainError> {
        let (Trainable { anchors, first, second, masks }, statistics) = self.read()?;
        let Lattice { voxel, origin: [x, y, z] } = anchors.lattice;
        let mut state = LearnerState::default();
        state.put("lattice", vec![voxel, x, y, z]);
        if !self.neural.unit().is_usual() {
            state.put("unit", vec![self.neural.unit().length()]);
        }
        state.put("anchors.cells", anchors.cells.into_flattened());
        state.put("anchors.masks", anchors.masks);
        state.put("anchors.rows", anchors.values);
        state.put("anchors.rows.first", first);
        state.put("anchors.rows.second", second);
        state.put("growth", statistics.values);
        state.put("networks", self.device.read(&self.device_anchors.networks)?);
        state.put("networks.first", self.device.read(&self.network_moments.first)?);
        state.put("networks.second", self.device.read(&self.network_moments.second)?);
        if let Some(masks) = masks {
            state.put("masks.logits", masks.logits);
            state.put("masks.logits.first", masks.first);
            state.put("masks.logits.second", masks.second);
        }
        if let Some(compression) = &self.compression {
            compression.save(&mut state)?;
        }
        Ok(state)
    }

    fn finish(mut self: Box<Self>, frames: &[&Frame], cancel: &CancelFlag) -> Result<Finished, TrainError> {
        let before = self.anchors.cells.clone();
        let mut anchors = self.anchors.clone();
        anchors.values = self.device.read(&self.device_anchors.rows)?;
        anchors.masks = self.device.read(&self.device_anchors.masks)?;
        let networks = self.device.read(&self.device_anchors.networks)?;
        self.mask_unused(self.schedule.steps, &mut anchors, frames, cancel)?;
        anchors.drop_empty();
        if anchors.is_empty() {
            return Err(TrainError::NothingLeft { step: self.schedule.steps });
        }
        let context = match self.compression {
            Some(compression) => compression.finish(&self.adam, &before, &mut anchors, &networks, cancel)?,
            None => None,
        };
        let scene = anchors.to_scene(self.layout.to_networks(&networks));
        let near = NearPlane::of_extent(self.extent);
        let scene = Scene::Anchors(AnchorScene { near, unit: self.neural.unit(), ..scene });
        Ok(Finished { scene, context })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_unit_of_a_state_is_the_one_that_was_kept_or_the_usual_one() {
        assert!(unit_of(&mut LearnerState::default()).expect("the usual").is_usual());
        let read = |values: Vec<f32>| {
            let mut state = LearnerState::default();
            state.put("unit", values);
            let unit = unit_of(&mut state)?;
            state.finish().map(|()| unit.length())
        };
        assert_eq!(read(vec![0.0025]).expect("a length"), 0.0025);
        for hostile in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-45, f32::MAX] {
            assert!(read(vec![hostile]).expect_err("refused").to_string().contains("'unit'"), "{hostile}");
        }
        assert!(read(vec![]).is_err() && read(vec![1.0, 2.0]).is_err());
    }
}
