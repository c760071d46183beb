//! The anchor model's state in a checkpoint.

use std::sync::Arc;

use super::{AnchorTrainer, Parts};
use crate::{
    domain::Lattice,
    gpu::Device,
    init::MAX_CELL,
    model::{AnchorRows, ModelShape, NetworkLayout},
    train::{
        CheckpointError, MaskRows, Result, Schedule, Statistics, checkpoint::ModelState,
        compression::Compression, densify::TrainableAnchors,
    },
};

fn lattice_values(values: &[f32]) -> Result<[f32; 4], CheckpointError> {
    match <[f32; 4]>::try_from(values) {
        Ok(values) if values[0] > 0.0 && values.iter().all(|v| v.is_finite()) => Ok(values),
        _ => Err(CheckpointError::array("lattice", "is not a size and an origin")),
    }
}

/// The shape of a state: the schedule's, or that after channel pruning.
fn shape_of(state: &mut ModelState, of_schedule: ModelShape) -> Result<ModelShape, CheckpointError> {
    if !state.has("shape") {
        return Ok(of_schedule);
    }
    let widths = state.take_exactly::<u32>("shape", 3)?;
    let [features, hidden, offsets] = [0, 1, 2].map(|index| widths[index] as usize);
    let shape = ModelShape { features, hidden, offsets, ..of_schedule };
    // Larger widths would allocate more than the memory estimate.
    if shape.check().is_err()
        || features > of_schedule.features
        || hidden > of_schedule.hidden
        || offsets > of_schedule.offsets
    {
        return Err(CheckpointError::array("shape", "is not one that this run can have"));
    }
    Ok(shape)
}

impl AnchorTrainer {
    /// The trainer with the state that [`ModelTrainer::save`] returned.
    pub(in crate::train) fn resume(
        device: &Arc<Device>,
        schedule: Schedule,
        extent: f32,
        mut state: ModelState,
    ) -> Result<Self> {
        let shape = shape_of(&mut state, schedule.shape)?;
        let [voxel, origin @ ..] = lattice_values(&state.take_exactly::<f32>("lattice", 4)?)?;
        let flat: Vec<i32> = state.take("anchors.cells")?;
        let cells: Vec<[i32; 3]> = flat.as_chunks().0.to_vec();
        let anchors = cells.len();
        if anchors == 0
            || flat.len() != 3 * anchors
            || flat.iter().any(|c| c.unsigned_abs() > MAX_CELL as u32)
        {
            let error = format!("has {} values, or some outside the lattice", flat.len());
            return Err(CheckpointError::array("anchors.cells", error).into());
        }
        let rows = anchors * shape.row();
        let offsets = anchors * shape.offsets;
        let parameters = NetworkLayout::new(shape).parameters;
        let masks = state.take_exactly("anchors.masks", anchors)?;
        let learning = state.has("masks.logits");
        let mut floats = |name: &str, len: usize| state.take_exactly::<f32>(name, len);
        let mut parts = Parts {
            compression: None,
            statistics: Statistics { shape, values: floats("growth", anchors * Statistics::width(shape))? },
            networks: [
                floats("networks", parameters)?,
                floats("networks.first", parameters)?,
                floats("networks.second", parameters)?,
            ],
            state: TrainableAnchors {
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

    /// The trainer's state.
    pub(super) fn to_state(&self) -> Result<ModelState> {
        let (TrainableAnchors { anchors, first, second, masks }, statistics) = self.read()?;
        let Lattice { voxel, origin: [x, y, z] } = anchors.lattice;
        let mut state = ModelState::default();
        state.put("lattice", vec![voxel, x, y, z]);
        if self.shape != self.schedule.shape {
            let ModelShape { features, hidden, offsets, .. } = self.shape;
            state.put("shape", [features, hidden, offsets].map(|width| width as u32).to_vec());
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
}
