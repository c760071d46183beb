//! Chooses quantisation steps by what they cost in picture quality: for each attribute the coarsest step of a ladder
//! that training views do not notice, then all three together.

use std::sync::Arc;

use crate::{
    domain::{AnchorScene, Background, Frame},
    eval::{mean_scores, measure_views},
    gpu::Context,
    render::{RenderError, SceneRenderer},
    train::BaseSteps,
};

/// PSNR in dB that one attribute's quantisation may cost on the views.
const LOSS_OF_ONE: f64 = 0.02;
/// PSNR in dB that all together may cost.
const LOSS_OF_ALL: f64 = 0.05;
/// Coarsest steps: features, scalings in voxels, offsets. Each further rung halves them.
const COARSEST: [f32; 3] = [1.0, 1.0, 0.4];
/// Rungs of the ladder.
const RUNGS: u32 = 9;

/// Largest magnitude of an integer here: half of what a file can hold (FORMAT.md), so that no rounding passes that.
const LARGEST_INTEGER: f32 = (1_u32 << 23) as f32;

/// The coarsest steps that `views` hardly notice. `go_on` is asked between measurements; once it says no, the finest
/// steps are returned.
///
/// # Errors
/// Faults of the renderer.
pub(super) fn choose_steps(
    context: &Arc<Context>,
    scene: &AnchorScene,
    views: &[&Frame],
    background: Background,
    go_on: &mut dyn FnMut() -> bool,
) -> Result<BaseSteps, RenderError> {
    let mut renderer = SceneRenderer::new(context, scene, background)?;
    let mut psnr = |scene: &AnchorScene| -> Result<f64, RenderError> {
        renderer.replace(scene)?;
        Ok(mean_scores(&measure_views(&mut renderer, views, background)?).psnr.unwrap_or(0.0))
    };
    let ladder = Ladder::of(scene);
    let best = psnr(scene)?;
    let mut rungs = [RUNGS; 3];
    for attribute in 0..3 {
        // A finer step never looks worse by more than noise, so the coarsest good rung is found by halving.
        let (mut good, mut bad) = (RUNGS, None);
        while let Some(rung) = between(bad, good) {
            if !go_on() {
                return Ok(ladder.steps([RUNGS; 3]));
            }
            let mut only = [None; 3];
            only[attribute] = Some(rung);
            if psnr(&quantised(scene, &ladder, only))? >= best - LOSS_OF_ONE {
                good = rung;
            } else {
                bad = Some(rung);
            }
        }
        rungs[attribute] = good;
    }
    while rungs.iter().any(|rung| *rung < RUNGS) && go_on() {
        if psnr(&quantised(scene, &ladder, rungs.map(Some)))? >= best - LOSS_OF_ALL {
            break;
        }
        rungs = rungs.map(|rung| (rung + 1).min(RUNGS));
    }
    Ok(ladder.steps(rungs))
}

/// A rung strictly between the finest known bad one and the coarsest known good one.
fn between(bad: Option<u32>, good: u32) -> Option<u32> {
    let first = bad.map_or(0, |bad| bad + 1);
    (first < good).then(|| first + (good - first) / 2)
}

/// The steps to choose from: halved from rung to rung, but none so fine that a file could not hold the integers. One
/// anchor far larger than the voxel would otherwise make a trained scene impossible to write.
struct Ladder {
    finest: [f32; 3],
}

impl Ladder {
    fn of(scene: &AnchorScene) -> Self {
        let largest = |values: &[f32]| values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
        let largest = [
            largest(&scene.features),
            largest(&scene.scalings) / scene.lattice.voxel,
            largest(&scene.offsets),
        ];
        Self { finest: largest.map(|largest| largest / LARGEST_INTEGER) }
    }

    fn steps(&self, rungs: [u32; 3]) -> BaseSteps {
        let step = |attribute: usize| {
            (COARSEST[attribute] * 0.5_f32.powi(rungs[attribute] as i32)).max(self.finest[attribute])
        };
        BaseSteps { feature: step(0), scaling: step(1), offset: step(2) }
    }
}

/// The scene with the attributes that have a rung rounded to its step, as the codec will round them.
fn quantised(scene: &AnchorScene, ladder: &Ladder, rungs: [Option<u32>; 3]) -> AnchorScene {
    let mut rounded = scene.clone();
    let steps = ladder.steps(rungs.map(|rung| rung.unwrap_or(0)));
    let round = |values: &mut [f32], step: f32, least: f32| {
        for value in values {
            *value = (*value / step).round_ties_even().max(least) * step;
        }
    };
    if rungs[0].is_some() {
        round(&mut rounded.features, steps.feature, f32::NEG_INFINITY);
    }
    if rungs[1].is_some() {
        round(&mut rounded.scalings, steps.scaling * scene.lattice.voxel, 1.0);
    }
    if rungs[2].is_some() {
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
        model::{AnchorRows, NetworkLayout, Shape},
    };

    #[test]
    fn halving_finds_every_rung() {
        for wanted in 0..=RUNGS {
            let (mut good, mut bad, mut asked) = (RUNGS, None, 0);
            while let Some(rung) = between(bad, good) {
                asked += 1;
                if rung >= wanted { good = rung } else { bad = Some(rung) }
            }
            assert_eq!(good, wanted);
            assert!(asked <= 4, "{asked} measurements for rung {wanted}");
        }
    }

    #[test]
    fn rungs_halve_the_steps() {
        let ladder = Ladder { finest: [0.0; 3] };
        let (coarse, fine) = (ladder.steps([0; 3]), ladder.steps([1; 3]));
        assert_eq!([coarse.feature, coarse.scaling, coarse.offset], COARSEST);
        assert_eq!(fine.feature * 2.0, coarse.feature);
    }

    #[test]
    fn the_finest_steps_of_a_scene_with_one_vast_anchor_can_still_be_written() {
        let shape = Shape { features: 4, offsets: 2 };
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
        let steps = Ladder::of(&scene).steps([RUNGS; 3]);
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
        codec::encode(&scene, None, &settings).expect("can be written");
    }
}
