//! Plain Gaussians from their parameters and back: kernels against twins, twins against central differences, both against
//! the independent values.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs_codec::domain::{Camera, GaussianScene, Pose};
use tcgs_render::{
    DeviceGaussians, PlainGaussians, Projection, RasterSettings, Rasterizer, RenderError, STATISTICS,
    gpu::Device,
    model::{
        GaussianRows,
        gaussian_rows::{BASE, COLOR, LOG_SCALE, OPACITY, QUAT},
    },
    twin::{
        self, Gaussian, GaussianGradient,
        plain::{PlainRow, gaussian_statistics, shade_gaussians, shade_gradient},
    },
};

use crate::support::{
    gpu::{gpu, variants},
    oracle::{Oracle, relative_l2},
    random,
    scene::{flat, sections},
};

const NEAR: f32 = 0.2;

/// Rounding of f32 over some fifty operations is a few 1e-6; exp and the logistic may be good to a few units less.
const BOUND: f64 = 1e-5;

/// Rows in the box [-1, 1]³ with every coefficient in use, some too transparent to be seen, some so dark that channels
/// are clamped at zero.
fn rows(seed: u64, count: usize) -> GaussianRows {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut rows = GaussianRows::zero(count);
    for index in 0..count {
        let mut number = |low: f32, high: f32| rng.random_range(low..high);
        let row = rows.base_mut(index);
        row[..LOG_SCALE].fill_with(|| number(-1.0, 1.0));
        row[LOG_SCALE..QUAT].fill_with(|| number(-5.0, -1.0));
        row[QUAT..OPACITY].fill_with(|| number(-1.0, 1.0));
        row[OPACITY] = number(-7.0, 4.0);
        row[COLOR..].fill_with(|| number(-2.5, 2.0));
        rows.bands.iter_mut().for_each(|band| {
            let width = band.len() / count;
            band[index * width..(index + 1) * width].fill_with(|| number(-0.6, 0.6));
        });
    }
    rows
}

fn twin_row(rows: &GaussianRows, index: usize) -> PlainRow {
    let coefficients = rows.coefficients(index);
    PlainRow {
        base: std::array::from_fn(|k| f64::from(rows.base(index)[k])),
        sh: std::array::from_fn(|k| DVec3::from([0, 1, 2].map(|c| f64::from(coefficients[3 * k + c])))),
    }
}

fn twin_rows(rows: &GaussianRows) -> Vec<PlainRow> {
    (0..rows.len()).map(|index| twin_row(rows, index)).collect()
}

fn projection(camera: &Camera) -> Projection {
    Projection::new(camera, &RasterSettings { near: NEAR, ..RasterSettings::default() })
}

/// A camera in the middle of the box: half of it is behind the near plane.
fn inside() -> Camera {
    let pose =
        Pose::look_at(DVec3::new(0.1, 0.0, -0.2), DVec3::new(1.0, 0.3, 0.1), DVec3::Z).expect("a view");
    Camera::new(random::camera(40, 30).intrinsics, pose).expect("a camera")
}

/// Gradients by a Gaussian and by its projected center; tiles that it touches and radius.
type Given = (GaussianGradient, DVec2, u32, f64);

/// Random gradients; a quarter of the Gaussians touch no tile.
fn gradients(seed: u64, count: usize) -> Vec<Given> {
    let mut rng = Pcg64::seed_from_u64(seed);
    (0..count)
        .map(|index| {
            let mut number = || f64::from(rng.random_range(-1.0..1.0_f32));
            let mut three = || DVec3::new(number(), number(), number());
            let (mean, scale, color, center) = (three(), three(), three(), three());
            let gradient = GaussianGradient { mean, opacity: center.z, scale, quat: [0.5; 4], color };
            // A view that shows nothing of a Gaussian that counts gives it none.
            let center = if index % 5 == 1 { DVec3::ZERO } else { center };
            (gradient, center.truncate(), if index % 4 == 3 { 0 } else { 2 }, 10.0 + center.x)
        })
        .collect()
}

struct Found {
    /// Positions and opacities, scales, quaternions, colors.
    gaussians: [Vec<[f32; 4]>; 4],
    d_rows: GaussianRows,
    statistics: Vec<f32>,
}

/// Both passes and the statistics, into buffers full of NaN (the statistics begin at one).
fn run(device: &Arc<Device>, plain: &mut PlainGaussians, rows: &GaussianRows, camera: &Camera) -> Found {
    let device_gaussians = DeviceGaussians::upload(device, rows).expect("room");
    let mut recorder = device.recorder("forward");
    plain.forward(&mut recorder, &device_gaussians, camera).expect("recorded");
    recorder.submit().expect("submitted");
    let out = plain.gaussians().clone();
    assert_eq!(device.read(&out.count).expect("a count")[0] as usize, rows.len());
    let [means, scales, quats] = sections(device, &out.geometry, rows.len());
    let gaussians = [means, scales, quats, device.read(&out.colors).expect("a column")];

    let d = plain.gaussian_gradients().expect("room").clone();
    let given = gradients(9, rows.len());
    let nan = f64::NAN;
    let column = |row: &dyn Fn(&Given) -> [f64; 4]| -> Vec<[f32; 4]> {
        given.iter().map(|given| row(given).map(|v| v as f32)).collect()
    };
    let geometry = [
        column(&|(v, ..)| v.mean.extend(v.opacity).to_array()),
        column(&|(v, ..)| v.scale.extend(nan).to_array()),
        column(&|(v, ..)| v.quat),
    ];
    device.write(&d.geometry, &geometry.concat());
    device.write(&d.colors, &column(&|(v, ..)| v.color.extend(nan).to_array()));
    // Culled Gaussians have no gradient, and their values must not count.
    let opacity = |index: usize| gaussians[0][index][3];
    let centers: Vec<[f32; 4]> = given
        .iter()
        .enumerate()
        .map(|(index, (_, center, tiles, radius))| {
            let tiles = if opacity(index) > 0.0 { f64::from(*tiles) } else { 0.0 };
            [center.x, center.y, tiles, *radius].map(|v| v as f32)
        })
        .collect();
    device.write(&d.means2d, &centers);

    let spoiled = DeviceGaussians::plan(rows.len()).make(device).expect("room");
    device.write(&spoiled.base, &vec![f32::NAN; spoiled.base.len()]);
    device.write(&spoiled.bands, &vec![f32::NAN; spoiled.bands.len()]);
    let statistics = device.upload("statistics", &vec![1.0_f32; STATISTICS * rows.len()]).expect("room");
    let mut recorder = device.recorder("backward");
    plain.backward(&mut recorder, &device_gaussians, &spoiled).expect("recorded");
    // An overflowed pass adds nothing.
    for mark in [1_u32, 0] {
        let mark = device.upload("overflow flag", &[mark]).expect("room");
        plain.statistics(&mut recorder, &statistics, &mark).expect("recorded");
    }
    recorder.submit().expect("submitted");
    Found {
        gaussians,
        d_rows: spoiled.download(device).expect("read"),
        statistics: device.read(&statistics).expect("read"),
    }
}

fn assert_near(what: &str, found: &[f64], expected: &[f64]) {
    let error = relative_l2(found, expected);
    assert!(error < BOUND, "{what}: {error:e}");
}

/// Compares everything with the twin; returns how many Gaussians are visible.
fn matches_twin(
    device: &Arc<Device>,
    rows: &GaussianRows,
    camera: &Camera,
    degree: u32,
    masked: bool,
) -> usize {
    let mut plain = PlainGaussians::new(Arc::clone(device), NEAR).expect("the kernels");
    if masked {
        plain.count_views_with_gradient().expect("the kernel");
    }
    plain.set_degree(degree).expect("the kernels");
    let found = run(device, &mut plain, rows, camera);
    let projection = projection(camera);
    let shaded: Vec<Option<Gaussian>> =
        twin_rows(rows).iter().map(|row| shade_gaussians(&projection, row, degree)).collect();
    let seen: Vec<usize> = (0..rows.len()).filter(|index| shaded[*index].is_some()).collect();
    for (index, (found, expected)) in found.gaussians[0].iter().zip(&shaded).enumerate() {
        assert_eq!(found[3] > 0.0, expected.is_some(), "Gaussian {index}");
    }
    let column = |at: usize, width: usize| -> Vec<f64> {
        let kept: Vec<_> = seen.iter().map(|index| found.gaussians[at][*index]).collect();
        flat(&kept, width)
    };
    let of = |values: &dyn Fn(&Gaussian) -> Vec<f64>| -> Vec<f64> {
        shaded.iter().flatten().flat_map(values).collect()
    };
    assert_near("means and opacities", &column(0, 4), &of(&|g| g.mean.extend(g.opacity).to_array().into()));
    assert_near("scales", &column(1, 3), &of(&|g| g.scale.to_array().into()));
    assert_near("quaternions", &column(2, 4), &of(&|g| g.quat.into()));
    assert_near("colors", &column(3, 3), &of(&|g| g.color.to_array().into()));

    let (mut by_base, mut by_sh) = (Vec::new(), [Vec::new(), Vec::new(), Vec::new()]);
    let mut statistics = Vec::new();
    for (index, (gradient, center, tiles, radius)) in gradients(9, rows.len()).iter().enumerate() {
        let row = twin_row(rows, index);
        let tiles = if shaded[index].is_some() { *tiles } else { 0 };
        let d = match &shaded[index] {
            Some(gaussian) if tiles > 0 => shade_gradient(&projection, &row, degree, gaussian, gradient),
            _ => PlainRow::ZERO,
        };
        by_base.push(d.base);
        for (part, range) in by_sh.iter_mut().zip([0..3, 3..8, 8..15]) {
            part.extend(d.sh[range].iter().flat_map(|v| v.to_array()));
        }
        let mut row = [1.0; STATISTICS];
        gaussian_statistics(&projection, *center, tiles, *radius, masked, &mut row);
        statistics.extend(row);
    }
    let numbers = |values: &[f32]| -> Vec<f64> { values.iter().map(|v| f64::from(*v)).collect() };
    for (what, range) in [
        ("mean", 0..LOG_SCALE),
        ("log-scale", LOG_SCALE..QUAT),
        ("quaternion", QUAT..OPACITY),
        ("opacity", OPACITY..COLOR),
        ("color", COLOR..BASE),
    ] {
        let part = |rows: &mut dyn Iterator<Item = Vec<f64>>| -> Vec<f64> {
            rows.flat_map(|row| row[range.clone()].to_vec()).collect()
        };
        let found = part(&mut found.d_rows.base.chunks_exact(BASE).map(numbers));
        assert_near(what, &found, &part(&mut by_base.iter().map(|row| row.to_vec())));
    }
    for (band, (found, expected)) in found.d_rows.bands.iter().zip(&by_sh).enumerate() {
        if band < degree as usize {
            assert_near(&format!("coefficients of degree {}", band + 1), &numbers(found), expected);
        } else {
            assert!(found.iter().all(|v| v.is_nan()), "the band above the degree is not written");
        }
    }
    assert_near("statistics", &numbers(&found.statistics), &statistics);
    seen.len()
}

#[test]
fn kernels_match_the_twin_at_every_degree() {
    for device in variants() {
        for degree in 0..=3 {
            for count in [1, 63, 64, 65, 700] {
                matches_twin(
                    &device,
                    &rows(count as u64, count),
                    &random::camera(40, 30),
                    degree,
                    count % 2 == 0,
                );
            }
            let seen = matches_twin(&device, &rows(3, 700), &inside(), degree, degree == 1);
            assert!((100..400).contains(&seen), "a part is behind the camera: {seen}");
        }
    }
}

#[test]
fn both_variants_of_the_kernels_give_the_same_bits_on_a_software_adapter() {
    // A GPU's compiler may fuse multiplications and additions in one variant and not in the other. There each matches the twin.
    if !gpu().adapter().is_software() {
        return println!("a hardware adapter");
    }
    let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<u32>>();
    for degree in 0..=3 {
        for count in [1, 64, 65, 700] {
            let rows = rows(count as u64, count);
            let [software, hardware] = variants().map(|device| {
                let mut plain = PlainGaussians::new(Arc::clone(&device), NEAR).expect("the kernels");
                plain.set_degree(degree).expect("the kernels");
                let gradients = run(&device, &mut plain, &rows, &random::camera(40, 30)).d_rows;
                (bits(&gradients.base), gradients.bands.each_ref().map(|band| bits(band)))
            });
            assert!(software == hardware, "{count} Gaussians of degree {degree}");
        }
    }
}

#[test]
fn some_channels_are_held_at_zero_and_pass_no_gradient() {
    let camera = random::camera(40, 30);
    let projection = projection(&camera);
    let mut held = 0;
    for row in twin_rows(&rows(4, 300)) {
        let Some(gaussian) = shade_gaussians(&projection, &row, 3) else { continue };
        let gradient = GaussianGradient { color: DVec3::ONE, ..GaussianGradient::default() };
        let d = shade_gradient(&projection, &row, 3, &gaussian, &gradient);
        for channel in 0..3 {
            let zero = gaussian.color[channel] == 0.0;
            assert_eq!(zero, d.base[COLOR + channel] == 0.0);
            assert!(!zero || d.sh.iter().all(|v| v[channel] == 0.0));
            held += usize::from(zero);
        }
    }
    assert!(held > 20, "{held}");
}

/// A linear form of all values of a Gaussian, whose gradient by the row [`shade_gradient`] must give.
fn said(projection: &Projection, row: &PlainRow, degree: u32, v: &GaussianGradient) -> f64 {
    let g = shade_gaussians(projection, row, degree).expect("in view");
    let quat: f64 = g.quat.iter().zip(v.quat).map(|(q, v)| q * v).sum();
    g.mean.dot(v.mean) + g.opacity * v.opacity + g.scale.dot(v.scale) + quat + g.color.dot(v.color)
}

#[test]
fn the_twin_matches_central_differences() {
    const STEP: f64 = 1e-5;
    let projection = projection(&random::camera(40, 30));
    let given = gradients(3, 40);
    for degree in 0..=3 {
        for (row, (v, ..)) in twin_rows(&rows(8, 40)).iter().zip(&given) {
            let Some(gaussian) = shade_gaussians(&projection, row, degree) else { continue };
            let near_the_hold = gaussian.color.min_element() < 1e-3 && gaussian.color.min_element() > 0.0;
            if near_the_hold {
                continue;
            }
            let found = shade_gradient(&projection, row, degree, &gaussian, v);
            let slope = |change: &dyn Fn(&mut PlainRow, f64)| {
                let at = |step: f64| {
                    let mut moved = row.clone();
                    change(&mut moved, step);
                    said(&projection, &moved, degree, v)
                };
                (at(STEP) - at(-STEP)) / (2.0 * STEP)
            };
            let near = |found: f64, expected: f64| (found - expected).abs() < 1e-7 * (1.0 + expected.abs());
            for k in 0..BASE {
                let expected = slope(&|row, step| row.base[k] += step);
                assert!(near(found.base[k], expected), "base {k}: {} {expected}", found.base[k]);
            }
            for k in 0..15 {
                for channel in 0..3 {
                    let expected = slope(&|row, step| row.sh[k][channel] += step);
                    assert!(near(found.sh[k][channel], expected), "{k}: {} {expected}", found.sh[k]);
                }
            }
        }
    }
}

/// The rows of an oracle's Gaussians.
fn oracle_rows(oracle: &Oracle) -> GaussianRows {
    let (means, scales) = (oracle.rows("in.means", 3), oracle.rows("in.scales", 3));
    let (quats, sh) = (oracle.rows("in.quats", 4), oracle.rows("in.sh", 48));
    let three = |row: &[f64]| [row[0], row[1], row[2]].map(|v| v as f32);
    let scene = GaussianScene {
        means: means.iter().map(|row| three(row)).collect(),
        log_scales: scales.iter().map(|row| three(row).map(f32::ln)).collect(),
        quats: quats.iter().map(|row| [0, 1, 2, 3].map(|k| row[k] as f32)).collect(),
        opacity_logits: oracle.numbers("in.opacities").iter().map(|o| (o / (1.0 - o)).ln() as f32).collect(),
        sh: sh.iter().map(|row| std::array::from_fn(|k| three(&row[3 * k..]))).collect(),
        degree: 3,
        ..GaussianScene::default()
    };
    GaussianRows::from_scene(&scene)
}

#[test]
fn the_whole_way_to_the_image_and_back_matches_the_oracles() {
    for case in ["base", "sh_negative_clamp", "odd_size_offcentre"] {
        let oracle = Oracle::load(case);
        assert_eq!(oracle.numbers("in.WH_deg_aa")[2], 3.0, "{case}");
        let (device, camera, settings) = (gpu(), oracle.camera(), oracle.settings());
        let rows = oracle_rows(&oracle);
        let device_gaussians = DeviceGaussians::upload(&device, &rows).expect("room");
        let mut plain = PlainGaussians::new(Arc::clone(&device), settings.near).expect("the kernels");
        plain.set_degree(3).expect("the kernels");
        let mut raster = Rasterizer::new(Arc::clone(&device), settings).expect("a rasterizer");
        let background = oracle.background().as_vec3().to_array();
        loop {
            let mut recorder = device.recorder("forward");
            plain.forward(&mut recorder, &device_gaussians, &camera).expect("recorded");
            raster.forward(&mut recorder, plain.gaussians(), &camera, background).expect("recorded");
            recorder.submit().expect("submitted");
            let counts = raster.counts().expect("counts");
            if !counts.overflowed {
                break;
            }
            raster.grow(&counts).expect("grown");
        }
        let d_image: Vec<[f32; 4]> = oracle.d_image().iter().map(|v| v.map(|v| v as f32)).collect();
        let d_image = device.upload("v_image", &d_image).expect("room");
        let d = plain.gaussian_gradients().expect("room").clone();
        let out = DeviceGaussians::plan(rows.len()).make(&device).expect("room");
        let mut recorder = device.recorder("backward");
        raster.backward(&mut recorder, plain.gaussians(), &camera, &d_image, &d).expect("recorded");
        plain.backward(&mut recorder, &device_gaussians, &out).expect("recorded");
        recorder.submit().expect("submitted");

        let image = device.read(raster.image()).expect("read");
        for (found, expected) in flat(&image, 3).iter().zip(oracle.numbers("f64.rgb")) {
            assert!((found - expected).abs() < 1e-4, "{case}: {found} {expected}");
        }
        let found = out.download(&device).expect("read");
        let base = |first: usize, width: usize| -> Vec<f64> {
            let rows = found.base.chunks_exact(BASE);
            rows.flat_map(|row| row[first..first + width].to_vec()).map(f64::from).collect()
        };
        let (scales, opacities) = (oracle.numbers("in.scales"), oracle.numbers("in.opacities"));
        let by_log: Vec<f64> =
            oracle.numbers("f64.v_scales").iter().zip(&scales).map(|(v, s)| v * s).collect();
        let by_logit: Vec<f64> = oracle
            .numbers("f64.v_opacities")
            .iter()
            .zip(&opacities)
            .map(|(v, o)| v * o * (1.0 - o))
            .collect();
        let sh: Vec<f64> = (0..rows.len())
            .flat_map(|index| {
                let constant = found.base(index)[COLOR..].to_vec();
                [constant, found.coefficients(index)].concat()
            })
            .map(f64::from)
            .collect();
        for (what, found, expected) in [
            ("means", base(0, 3), oracle.numbers("f64.v_means")),
            ("log-scales", base(LOG_SCALE, 3), by_log),
            ("quaternions", base(QUAT, 4), oracle.numbers("f64.v_quats")),
            ("opacities", base(OPACITY, 1), by_logit),
            ("spherical harmonics", sh, oracle.numbers("f64.v_sh")),
        ] {
            let error = relative_l2(&found, &expected);
            assert!(error < 1e-4, "{case}: {what} {error:e}");
        }
    }
}

#[test]
fn the_radius_is_three_deviations_along_the_longer_axis() {
    let device = gpu();
    let camera = random::camera(64, 48);
    let rows = rows(6, 300);
    let device_gaussians = DeviceGaussians::upload(&device, &rows).expect("room");
    let mut plain = PlainGaussians::new(Arc::clone(&device), NEAR).expect("the kernels");
    let mut raster = Rasterizer::new(Arc::clone(&device), RasterSettings::default()).expect("a rasterizer");
    let mut recorder = device.recorder("forward");
    plain.forward(&mut recorder, &device_gaussians, &camera).expect("recorded");
    raster.forward(&mut recorder, plain.gaussians(), &camera, [0.0; 3]).expect("recorded");
    let d = plain.gaussian_gradients().expect("room").clone();
    let d_image = device.upload("v_image", &random::d_image(1, 64 * 48)).expect("room");
    raster.backward(&mut recorder, plain.gaussians(), &camera, &d_image, &d).expect("recorded");
    recorder.submit().expect("submitted");
    assert!(!raster.counts().expect("counts").overflowed);
    let found = device.read(&d.means2d).expect("read");
    let mut seen = 0;
    for (index, found) in found.iter().enumerate().filter(|(_, found)| found[2] > 0.0) {
        let gaussian = shade_gaussians(&projection(&camera), &twin_row(&rows, index), 0).expect("in view");
        let splat =
            twin::project(&projection(&camera), &gaussian, twin::Cutoffs::default()).expect("in view");
        // The conic is the covariance's inverse: its smaller eigenvalue belongs to the longer axis.
        let (middle, half) = (0.5 * (splat.conic.x + splat.conic.z), 0.5 * (splat.conic.x - splat.conic.z));
        let min = middle - half.hypot(splat.conic.y);
        let radius = 3.0 / min.sqrt();
        assert!((f64::from(found[3]) / radius - 1.0).abs() < 1e-3, "{} {radius}", found[3]);
        seen += 1;
    }
    assert!(seen > 100, "{seen}");
}

#[test]
fn a_backward_pass_without_a_place_for_gradients_is_refused() {
    let device = gpu();
    let device_gaussians = DeviceGaussians::upload(&device, &rows(1, 3)).expect("room");
    let plain = PlainGaussians::new(Arc::clone(&device), NEAR).expect("the kernels");
    let mut recorder = device.recorder("backward");
    let refused = plain.backward(&mut recorder, &device_gaussians, &device_gaussians);
    assert_eq!(refused, Err(RenderError::OutOfStep));
}
