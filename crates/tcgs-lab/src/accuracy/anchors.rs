//! Cases of anchors: from anchors and networks through the Gaussians of a view to its image, and back.

use std::sync::Arc;

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{
    case::{Bound, Case, Errors},
    error::CaseError,
    norms::{largest_difference, relative_l2, unless},
    raster::{BACKGROUND, IMAGE, PLAIN, undecided},
    scenes::{camera, camera_at, d_image, forward_camera},
};
use tcgs_codec::domain::{Camera, Lattice, SceneScale};
use tcgs_render::{
    AnchorGradients, DeviceAnchors, NeuralGaussians, Projection, Rasterizer,
    gpu::Device,
    model::{AnchorRows, ModelShape, NetworkLayout, all_offsets},
    twin::{self, Cutoffs, GaussianGradient, neural},
};

const ROWS: &str = "gradient by anchors, relative L2";
const NETWORKS: &str = "gradient by networks, relative L2";
const EMPTY: &str = "image and gradients, 0 if those of an empty scene";

const WIDTHS: ModelShape = ModelShape::new(8, 3);

const fn bounds(gradients: f64, why: &'static str) -> [Bound; 3] {
    [
        Bound { quantity: IMAGE, largest: 1e-4, why },
        Bound { quantity: ROWS, largest: gradients, why },
        Bound { quantity: NETWORKS, largest: gradients, why },
    ]
}

const NOTHING: &[Bound] =
    &[Bound { quantity: EMPTY, largest: 0.0, why: "without Gaussians there is exactly the background" }];

const CHAIN: &str = "two layers of networks, the projection and the blending, forty roundings of 6e-8 each";

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case { name: "anchors-none-visible", bounds: NOTHING, measure: none_visible },
    Case { name: "anchors-all-masked", bounds: NOTHING, measure: all_masked },
    Case {
        name: "anchors-at-the-near-plane",
        bounds: &bounds(1e-3, "as Gaussians at the near plane"),
        measure: near_plane,
    },
    Case { name: "anchors-in-one-cell", bounds: &bounds(1e-4, CHAIN), measure: one_cell },
    Case { name: "anchors-1e5-from-the-origin", bounds: &bounds(1e-3, CHAIN), measure: far },
    Case { name: "anchors-not-finite", bounds: &bounds(1e-4, CHAIN), measure: not_finite },
];

/// Anchors with random parameters at `cells`, none masked, and networks.
fn anchors(seed: u64, lattice: Lattice, cells: Vec<[i32; 3]>) -> (AnchorRows, Vec<f32>) {
    let mut rng = Pcg64::seed_from_u64(seed);
    let networks = NetworkLayout::new(WIDTHS).initial(&mut rng);
    let mut values = Vec::new();
    for _ in &cells {
        let mut row: Vec<f32> = (0..WIDTHS.row()).map(|_| rng.random_range(-1.0..1.0)).collect();
        for log in &mut row[WIDTHS.scaling_column()..WIDTHS.offset_column()] {
            *log = *log * 0.8 - 2.0;
        }
        values.extend(row);
    }
    let masks = vec![all_offsets(WIDTHS); cells.len()];
    (AnchorRows { shape: WIDTHS, lattice, cells, values, masks }, networks)
}

/// Random cells within `reach` of the lattice's origin.
fn cells(seed: u64, count: usize, reach: i32) -> Vec<[i32; 3]> {
    let mut rng = Pcg64::seed_from_u64(seed);
    (0..count).map(|_| [0; 3].map(|_| rng.random_range(-reach..=reach))).collect()
}

const MILLI: Lattice = Lattice { voxel: 1e-3, origin: [0.0; 3] };

/// What the device computed.
struct Found {
    visible: u32,
    image: Vec<f64>,
    rows: Vec<f64>,
    networks: Vec<f64>,
}

fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

fn run(
    device: &Arc<Device>,
    (rows, networks): &(AnchorRows, Vec<f32>),
    camera: &Camera,
    d_image: &[[f32; 4]],
) -> Result<Found, CaseError> {
    let anchors = DeviceAnchors::upload(device, rows, networks)?;
    let mut neural = NeuralGaussians::new(Arc::clone(device), WIDTHS, PLAIN.near, SceneScale::DEFAULT)?;
    let mut rasterizer = Rasterizer::new(Arc::clone(device), PLAIN)?;
    let counts = rasterizer.submit_with_room("forward", |rasterizer, recorder| {
        neural.forward(recorder, &anchors, camera, 0.0)?;
        rasterizer.forward(recorder, neural.gaussians(), camera, BACKGROUND)
    })?;
    let d_image = device.upload("derivatives by the image", d_image)?;
    let d = neural.gaussian_gradients()?.clone();
    let out = AnchorGradients::plan(WIDTHS, rows.len()).make(device)?;
    let mut recorder = device.recorder("backward");
    rasterizer.backward(&mut recorder, neural.gaussians(), camera, &d_image, &d)?;
    neural.backward(&mut recorder, &anchors, &out)?;
    recorder.submit()?;
    Ok(Found {
        visible: counts.visible,
        image: f64s(device.read(rasterizer.image())?.as_flattened()),
        rows: f64s(&device.read(&out.rows)?),
        networks: f64s(&device.read(&out.networks)?),
    })
}

fn compare(
    device: &Arc<Device>,
    scene: &(AnchorRows, Vec<f32>),
    camera: &Camera,
) -> Result<Errors, CaseError> {
    let projection = Projection::new(camera, &PLAIN);
    let anchors = neural::Anchors::new(&scene.0, &scene.1, SceneScale::DEFAULT);
    let spawned = neural::neural_forward(&projection, &anchors);
    let gaussians: Vec<twin::Gaussian> = spawned.gaussians.iter().flatten().copied().collect();
    let background = DVec3::from(BACKGROUND.map(f64::from));
    let rendering = twin::forward(&projection, &gaussians, background, Cutoffs::default());
    let undecided = undecided(&projection, &rendering);
    let mut d_image = d_image(9, undecided.len());
    for (v, undecided) in d_image.iter_mut().zip(&undecided) {
        if *undecided {
            *v = [0.0; 4];
        }
    }
    let found = run(device, scene, camera, &d_image)?;
    let d_image: Vec<[f64; 4]> = d_image.iter().map(|v| v.map(f64::from)).collect();
    let (_, v) = twin::backward(&projection, &gaussians, &rendering, &d_image, Cutoffs::default());
    let mut v = v.into_iter();
    let v: Vec<GaussianGradient> = spawned
        .gaussians
        .iter()
        .map(|gaussian| gaussian.and_then(|_| v.next()).unwrap_or_default())
        .collect();
    let truth = neural::neural_backward(&anchors, &spawned, &v, 0.0);
    let decided = |image: &[f64]| -> Vec<f64> {
        let pixels = image.chunks(4).zip(&undecided).filter(|(_, undecided)| !**undecided);
        pixels.flat_map(|(pixel, _)| pixel.to_vec()).collect()
    };
    let image = rendering.frame.image.as_flattened();
    Ok(vec![
        (IMAGE, largest_difference(&decided(&found.image), &decided(image))),
        (ROWS, relative_l2(&found.rows, &truth.rows)),
        (NETWORKS, relative_l2(&found.networks, &truth.networks)),
    ])
}

/// Whether a view of the anchors is an empty scene's.
fn empty(device: &Arc<Device>, scene: &(AnchorRows, Vec<f32>), camera: &Camera) -> Result<Errors, CaseError> {
    let pixels = camera.intrinsics.width * camera.intrinsics.height;
    let found = run(device, scene, camera, &d_image(9, pixels as usize))?;
    let [r, g, b] = BACKGROUND.map(f64::from);
    let is_empty = found.visible == 0
        && found.image.chunks(4).all(|pixel| pixel == [r, g, b, 1.0])
        && found.rows.iter().chain(&found.networks).all(|v| *v == 0.0);
    Ok(vec![(EMPTY, unless(is_empty))])
}

/// All behind the camera.
fn none_visible(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let lattice = Lattice { voxel: 1e-3, origin: [0.0, 0.0, -3.0] };
    empty(device, &anchors(41, lattice, cells(41, 30, 1000)), &forward_camera(24, 20))
}

fn all_masked(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let mut scene = anchors(42, MILLI, cells(42, 30, 1000));
    scene.0.masks.fill(0);
    empty(device, &scene, &camera(24, 20))
}

/// Behind the camera, before it, and at the near plane to a few units in the last place.
fn near_plane(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let lattice = Lattice { voxel: 1.5e-8, origin: [0.0, 0.0, PLAIN.near] };
    let mut cells = cells(43, 40, 1_000_000);
    for (i, cell) in cells.iter_mut().enumerate() {
        cell[2] = [-2, -1, 0, 1, 2, 100, 1_000_000, -1_000_000][i % 8];
    }
    let mut scene = anchors(43, lattice, cells);
    for row in scene.0.values.chunks_mut(WIDTHS.row()) {
        // Small beside the depth of 0.2, with offsets that reach across the plane.
        row[WIDTHS.scaling_column()..WIDTHS.offset_column()].iter_mut().for_each(|log| *log -= 2.0);
    }
    compare(device, &scene, &forward_camera(32, 28))
}

/// Ten cells with four anchors each.
fn one_cell(device: &Arc<Device>) -> Result<Errors, CaseError> {
    compare(device, &anchors(44, MILLI, cells(44, 10, 1000).repeat(4)), &camera(40, 36))
}

/// A lattice whose origin is 1e5 from the world's, where neighboring f32 are 0.008 apart.
fn far(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let lattice = Lattice { voxel: 1.0 / 64.0, origin: [1e5, -1e5, 1e5] };
    let origin = DVec3::new(1e5, -1e5, 1e5);
    let camera = camera_at(origin + DVec3::new(3.0, -2.0, 1.7), origin, 40, 36);
    compare(device, &anchors(45, lattice, cells(45, 40, 64)), &camera)
}

/// Features and offsets that are no numbers: such a feature reads as zero, such an offset makes no Gaussian.
fn not_finite(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let mut scene = anchors(46, MILLI, cells(46, 40, 1000));
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e38];
    for (i, row) in scene.0.values.chunks_mut(WIDTHS.row()).enumerate() {
        match i % 3 {
            0 => row[i % WIDTHS.features] = bad[i / 3 % 4],
            1 => row[WIDTHS.offset_column() + i % 9] = bad[i / 3 % 4],
            _ => {}
        }
    }
    compare(device, &scene, &camera(40, 36))
}
