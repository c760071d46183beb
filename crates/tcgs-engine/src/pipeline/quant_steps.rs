//! Chooses quantization steps by their cost in PSNR on training views: for each attribute the coarsest step of a ladder that costs
//! next to nothing, then all three together.

use std::sync::Arc;

use crate::{
    domain::{AnchorScene, Background},
    eval::{TrainView, mean_psnr},
    gpu::Device,
    render::{RenderError, Renderer},
    train::BaseQuantSteps,
};

/// PSNR in dB that the quantization of one attribute may cost on the views.
const MAX_LOSS_OF_ONE: f64 = 0.02;
/// PSNR in dB that the quantization of all attributes may cost.
const MAX_LOSS_OF_ALL: f64 = 0.05;
/// Coarsest steps: features, scalings in voxels, offsets. Each further level halves them.
const COARSEST: [f32; 3] = [1.0, 1.0, 0.4];
/// Levels of the ladder below the coarsest.
const LEVELS: u32 = 9;

/// Largest magnitude of a quantized integer: half of what a file can hold (FORMAT.md), so that rounding cannot exceed that.
const MAX_INTEGER: f32 = (1_u32 << 23) as f32;

/// The coarsest steps that cost `views` less than the bounds above. Calls `keep_going` between measurements; returns the finest steps
/// once it returns false.
///
/// # Errors
/// Errors of the renderer.
pub(super) fn choose_quant_steps(
    device: &Arc<Device>,
    scene: &AnchorScene,
    views: &[TrainView<'_>],
    background: Background,
    keep_going: &mut dyn FnMut() -> bool,
) -> Result<BaseQuantSteps, RenderError> {
    let mut renderer = Renderer::new(device, scene, background)?;
    let mut psnr = |scene: &AnchorScene| -> Result<f64, RenderError> {
        renderer.replace(scene)?;
        mean_psnr(&mut renderer, views, background)
    };
    let ladder = StepLadder::of(scene);
    let best = psnr(scene)?;
    let mut levels = [LEVELS; 3];
    for attribute in 0..3 {
        // PSNR grows with finer steps, up to noise, so bisection finds the coarsest good level.
        let (mut good, mut bad) = (LEVELS, None);
        while let Some(level) = between(bad, good) {
            if !keep_going() {
                return Ok(ladder.steps([LEVELS; 3]));
            }
            let mut only = [None; 3];
            only[attribute] = Some(level);
            if psnr(&quantized(scene, &ladder, only))? >= best - MAX_LOSS_OF_ONE {
                good = level;
            } else {
                bad = Some(level);
            }
        }
        levels[attribute] = good;
    }
    while levels.iter().any(|level| *level < LEVELS) && keep_going() {
        if psnr(&quantized(scene, &ladder, levels.map(Some)))? >= best - MAX_LOSS_OF_ALL {
            break;
        }
        levels = levels.map(|level| (level + 1).min(LEVELS));
    }
    Ok(ladder.steps(levels))
}

/// A level strictly between the finest known bad one and the coarsest known good one.
fn between(bad: Option<u32>, good: u32) -> Option<u32> {
    let first = bad.map_or(0, |bad| bad + 1);
    (first < good).then(|| first + (good - first) / 2)
}

/// The steps to choose from: halved from level to level, but none so fine that a file could not hold the integers. Otherwise one
/// anchor far larger than the voxel would make a trained scene impossible to write.
struct StepLadder {
    finest: [f32; 3],
}

impl StepLadder {
    fn of(scene: &AnchorScene) -> Self {
        let largest = |values: &[f32]| values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
        let largest = [
            largest(&scene.features),
            largest(&scene.scalings) / scene.lattice.voxel,
            largest(&scene.offsets),
        ];
        Self { finest: largest.map(|largest| largest / MAX_INTEGER) }
    }

    fn steps(&self, levels: [u32; 3]) -> BaseQuantSteps {
        let step = |attribute: usize| {
            (COARSEST[attribute] * 0.5_f32.powi(levels[attribute] as i32)).max(self.finest[attribute])
        };
        BaseQuantSteps { feature: step(0), scaling: step(1), offset: step(2) }
    }
}

/// The scene with those attributes that have a level rounded to its step, as the codec will round them.
fn quantized(scene: &AnchorScene, ladder: &StepLadder, levels: [Option<u32>; 3]) -> AnchorScene {
    let mut rounded = scene.clone();
    let steps = ladder.steps(levels.map(|level| level.unwrap_or(0)));
    let round = |values: &mut [f32], step: f32, min: f32| {
        for value in values {
            *value = (*value / step).round_ties_even().max(min) * step;
        }
    };
    if levels[0].is_some() {
        round(&mut rounded.features, steps.feature, f32::NEG_INFINITY);
    }
    if levels[1].is_some() {
        round(&mut rounded.scalings, steps.scaling * scene.lattice.voxel, 1.0);
    }
    if levels[2].is_some() {
        round(&mut rounded.offsets, steps.offset, f32::NEG_INFINITY);
    }
    rounded
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        codec::{self, ContextSettings, EncodeSettings, Provenance},
        domain::Lattice,
        model::{AnchorRows, ModelShape, NetworkLayout},
    };

    #[test]
    fn bisection_finds_every_level() {
        for wanted in 0..=LEVELS {
            let (mut good, mut bad, mut measured) = (LEVELS, None, 0);
            while let Some(level) = between(bad, good) {
                measured += 1;
                if level >= wanted { good = level } else { bad = Some(level) }
            }
            assert_eq!(good, wanted);
            assert!(measured <= 4, "{measured} measurements for level {wanted}");
        }
    }

    #[test]
    fn levels_halve_the_steps() {
        let ladder = StepLadder { finest: [0.0; 3] };
        let (coarse, fine) = (ladder.steps([0; 3]), ladder.steps([1; 3]));
        assert_eq!([coarse.feature, coarse.scaling, coarse.offset], COARSEST);
        assert_eq!(fine.feature * 2.0, coarse.feature);
    }

    #[test]
    fn the_finest_steps_of_a_scene_with_one_huge_anchor_can_be_encoded() {
        let shape = ModelShape::new(4, 2);
        let layout = NetworkLayout::new(shape);
        let mut values = vec![0.0; 2 * shape.row()];
        values[shape.scaling_column()..shape.offset_column()].fill(-9.0);
        values[shape.row() + shape.scaling_column()..][..6].fill(5.0);
        let rows = AnchorRows {
            shape,
            lattice: Lattice { voxel: 1e-4, origin: [0.0; 3] },
            cells: vec![[0; 3], [9; 3]],
            values,
            masks: vec![3; 2],
        };
        let scene = rows.to_scene(layout.to_networks(&vec![0.1; layout.parameters]));
        let steps = StepLadder::of(&scene).steps([LEVELS; 3]);
        let settings = EncodeSettings {
            background: Background::Black,
            feature_step: steps.feature,
            scaling_step: steps.scaling,
            offset_step: steps.offset,
            context: ContextSettings::default(),
            provenance: Provenance {
                generator: "a test".to_owned(),
                dataset: None,
                adapter: None,
                settings: serde_json::Value::Null,
            },
        };
        codec::encode(&scene, None, &settings).expect("encodes");
    }
}
