//! Random anchors, and their passes on the device.

use std::{collections::BTreeSet, sync::Arc};

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs_codec::domain::{Camera, Lattice, SceneScale};
use tcgs_render::model::all_offsets;
use tcgs_render::{
    AnchorGradients, DeviceAnchors, NeuralGaussians, Projection, RasterSettings,
    gpu::Device,
    model::{AnchorRows, ModelShape, NetworkLayout},
    twin::{GaussianGradient, SplatGradient, neural as twin},
};

use crate::support::scene::sections;

/// Sizes that leave every tile of the kernels partly filled.
pub(super) const SMALL: ModelShape = ModelShape::new(8, 3);

/// The sizes that are trained.
pub(super) const USUAL: ModelShape = ModelShape::new(32, 10);

/// Anchors with networks.
#[derive(Clone)]
pub(super) struct Scene {
    pub(super) anchors: AnchorRows,
    pub(super) networks: Vec<f32>,
    pub(super) scene_scale: SceneScale,
}

impl Scene {
    pub(super) fn twin(&self) -> twin::Anchors {
        twin::Anchors::new(&self.anchors, &self.networks, self.scene_scale)
    }

    /// `count` anchors within `spread` of the middle, some of their offsets masked. None is so close to a decision of
    /// `projection` or of a ReLU that rounding might take it differently.
    pub(super) fn random(
        seed: u64,
        shape: ModelShape,
        count: usize,
        spread: f32,
        projection: &Projection,
    ) -> Self {
        Self::random_in(SceneScale::DEFAULT, seed, shape, count, spread, projection)
    }

    /// As [`Scene::random`], with distances in units of `unit`.
    pub(super) fn random_in(
        scene_scale: SceneScale,
        seed: u64,
        shape: ModelShape,
        count: usize,
        spread: f32,
        projection: &Projection,
    ) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let networks = NetworkLayout::new(shape).initial(&mut rng);
        let lattice = Lattice { voxel: spread / 1000.0, origin: [0.0; 3] };
        let empty = AnchorRows { shape, lattice, cells: vec![], values: vec![], masks: vec![] };
        let mut scene = Self { anchors: empty.clone(), networks, scene_scale };
        let mut taken = BTreeSet::new();
        while scene.anchors.len() < count {
            let cell = [0; 3].map(|_| rng.random_range(-1000..1000));
            let mut row: Vec<f32> = (0..shape.row()).map(|_| rng.random_range(-1.0..1.0_f32)).collect();
            for log in &mut row[shape.scaling_column()..shape.offset_column()] {
                *log = *log * 0.8 - 2.0;
            }
            let mask = all_offsets(shape) & (rng.random::<u32>() | rng.random::<u32>());
            let one = AnchorRows { cells: vec![cell], values: row, masks: vec![mask], ..empty.clone() };
            let one = Self { anchors: one, networks: scene.networks.clone(), scene_scale };
            if is_far_from_decisions(&one.twin(), projection) && taken.insert(cell) {
                scene.anchors.cells.push(cell);
                scene.anchors.values.extend(one.anchors.values);
                scene.anchors.masks.push(mask);
            }
        }
        scene
    }
}

fn is_far_from_decisions(anchor: &twin::Anchors, projection: &Projection) -> bool {
    const MARGIN: f64 = 2e-5;
    let (shape, layout) = (anchor.shape, NetworkLayout::new(anchor.shape));
    let scaled = |by: f64| {
        let mut row = anchor.row(0).to_vec();
        row[shape.scaling_column()..][..3].iter_mut().for_each(|log| *log += by);
        twin::anchor_visible(projection, anchor.positions[0], shape, &row)
    };
    let depth = (projection.rotation * anchor.positions[0] + projection.translation).z - projection.near;
    let input =
        twin::network_input(projection, anchor.positions[0], shape, anchor.row(0), anchor.scene_scale);
    let hidden = twin::dense(&layout.hidden, &anchor.networks, &input);
    let opacity = twin::dense(&layout.heads[0], &anchor.networks, &twin::relu(hidden.clone()));
    scaled(1e-3) == scaled(-1e-3)
        && depth.abs() > 1e-3
        && hidden.iter().chain(&opacity).all(|v| v.abs() > MARGIN)
}

pub(super) fn projection(camera: &Camera) -> Projection {
    Projection::new(camera, &RasterSettings::default())
}

/// A rasterizer's output for one Gaussian: the gradients, and the tiles that it touches.
pub(super) type Said = (GaussianGradient, SplatGradient, u32);

/// Random gradients by Gaussians, through f32.
pub(super) fn random_gradients(seed: u64, count: usize) -> Vec<Said> {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut number = || f64::from(rng.random_range(-1.0..1.0_f32));
    (0..count)
        .map(|_| {
            let mut three = || DVec3::new(number(), number(), number());
            let (mean, scale, color, center) = (three(), three(), three(), three());
            let by_gaussian = GaussianGradient {
                mean,
                opacity: number(),
                scale,
                quat: [number(), number(), number(), number()],
                color,
            };
            // A view that shows nothing of a Gaussian that counts gives it none.
            let center = if color.x > 0.8 { DVec3::Z * center.z } else { center };
            let by_splat = SplatGradient { center: center.truncate(), ..SplatGradient::default() };
            (by_gaussian, by_splat, if center.z > 0.0 { 3 } else { 0 })
        })
        .collect()
}

/// Results read back from the device.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Found {
    pub(super) counts: [u32; 3],
    /// Rows of the candidates: position and opacity, scales, quaternions, colors; zero where there is no opacity.
    pub(super) gaussians: [Vec<[f32; 4]>; 4],
    pub(super) d_rows: Vec<f32>,
    pub(super) d_networks: Vec<f32>,
    pub(super) statistics: Vec<f32>,
}

/// Bits, so that NaN equals itself.
pub(super) fn bits(found: &Found) -> Vec<u32> {
    let columns = found.gaussians.iter().flatten().flatten();
    let rest = found.d_rows.iter().chain(&found.d_networks).chain(&found.statistics);
    found.counts.into_iter().chain(columns.chain(rest).map(|v| v.to_bits())).collect()
}

/// Both passes and the statistics, into buffers full of NaN (the statistics begin at one).
pub(super) fn run(
    device: &Arc<Device>,
    neural: &mut NeuralGaussians,
    scene: &Scene,
    camera: &Camera,
    volume_weight: f32,
    gradients: &[Said],
) -> Found {
    let (shape, anchors) = (scene.anchors.shape, scene.anchors.len());
    let uploaded = DeviceAnchors::upload(device, &scene.anchors, &scene.networks).expect("anchors");
    let mut recorder = device.recorder("forward");
    neural.forward(&mut recorder, &uploaded, camera, volume_weight).expect("recorded");
    recorder.submit().expect("submitted");
    let counts = neural.counts().expect("counts");
    let candidates = counts[0] as usize;
    let gaussians = neural.gaussians().clone();
    let [means, scales, quats] = sections(device, &gaussians.geometry, candidates);
    let colors = device.read_range(&gaussians.colors, 0, candidates).expect("a column");
    let mut columns = [means, scales, quats, colors];
    // In the world.
    for row in columns[0].iter_mut().filter(|row| row[3] > 0.0) {
        (0..3).for_each(|axis| row[axis] += gaussians.origin[axis]);
    }
    // Without an opacity, the rest is whatever the buffer held before.
    let dead: Vec<usize> = (0..candidates).filter(|row| columns[0][*row][3] <= 0.0).collect();
    for column in &mut columns[1..] {
        dead.iter().for_each(|row| column[*row] = [0.0; 4]);
    }

    let d = neural.gaussian_gradients().expect("room").clone();
    let column = |row: &dyn Fn(&Said) -> [f64; 4]| {
        let mut rows = vec![[f32::NAN; 4]; gaussians.capacity];
        for (to, from) in rows.iter_mut().take(candidates).zip(gradients) {
            *to = row(from).map(|v| v as f32);
        }
        rows
    };
    let geometry = [
        column(&|(v, ..)| v.mean.extend(v.opacity).to_array()),
        column(&|(v, ..)| v.scale.extend(f64::NAN).to_array()),
        column(&|(v, ..)| v.quat),
    ];
    device.write(&d.geometry, &geometry.concat());
    device.write(&d.colors, &column(&|(v, ..)| v.color.extend(f64::NAN).to_array()));
    let centers = column(&|(_, v, tiles)| [v.center.x, v.center.y, f64::from(*tiles), f64::NAN]);
    device.write(&d.means2d, &centers);

    let spoiled = |len| device.upload("spoiled", &vec![f32::NAN; len]).expect("a buffer");
    let out = AnchorGradients {
        rows: spoiled(anchors * shape.row()),
        networks: spoiled(NetworkLayout::new(shape).parameters),
    };
    let statistics =
        device.upload("statistics", &vec![1.0_f32; anchors * (2 * shape.offsets + 2)]).expect("a buffer");
    let mut recorder = device.recorder("backward");
    neural.backward(&mut recorder, &uploaded, &out).expect("recorded");
    // An overflowed pass adds nothing.
    for mark in [1_u32, 0] {
        let mark = device.upload("overflow flag", &[mark]).expect("a buffer");
        neural.statistics(&mut recorder, &uploaded, &statistics, &mark).expect("recorded");
    }
    recorder.submit().expect("submitted");
    let read = |buffer| device.read(buffer).expect("read");
    Found {
        counts,
        gaussians: columns,
        d_rows: read(&out.rows),
        d_networks: read(&out.networks),
        statistics: read(&statistics),
    }
}
