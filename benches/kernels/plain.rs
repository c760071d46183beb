//! A whole step of plain Gaussians with spherical harmonics of degree 3: what `model=3dgs` does a photograph.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::{
    gpu::Device,
    model::GaussianRows,
    render::{DeviceGaussians, PlainGaussians, RasterSettings, Rasterizer, RenderError},
    train::{Adam, AdamStep, ImageLoss, Moments},
};

use super::scene;

/// The minimum wall time of a step, nothing read back.
pub(crate) fn step(
    device: &Arc<Device>,
    count: usize,
    side: u32,
    runs: usize,
) -> Result<Duration, RenderError> {
    let mut rng = Pcg64::seed_from_u64(3);
    let camera = scene::camera(side);
    let values = rows(&scene::shell(device, count), device, &mut rng)?;
    let [rows, gradients] =
        [&values, &GaussianRows::zero(count)].map(|values| DeviceGaussians::upload(device, values));
    let (rows, gradients) = (rows?, gradients?);
    let moments = |values: &GaussianRows| -> Result<[Moments; 2], RenderError> {
        let bands: usize = values.bands.iter().map(Vec::len).sum();
        Ok([Moments::plan(values.base.len()).make(device)?, Moments::plan(bands).make(device)?])
    };
    let [base, bands] = moments(&values)?;
    let mut plain = PlainGaussians::new(Arc::clone(device), RasterSettings::default().near)?;
    plain.set_degree(3)?;
    let mut rasterizer = Rasterizer::new(Arc::clone(device), RasterSettings::default())?;
    let mut loss = ImageLoss::new(Arc::clone(device))?;
    let adam = Adam::new(device)?;
    let photograph: Vec<u32> = (0..side * side).map(|_| rng.random()).collect();
    // So small that the scene stays as it is.
    let rates = device.upload("rates", &[1e-9_f32])?;
    let overflow_flag = device.upload("overflow flag", &[0_u32])?;
    let step = AdamStep { number: 1, overflow_flag: &overflow_flag };
    let mut least = Duration::MAX;
    for run in 0..=runs {
        let start = Instant::now();
        let mut recorder = device.recorder("step of plain Gaussians");
        plain.forward(&mut recorder, &rows, &camera)?;
        rasterizer.forward(&mut recorder, plain.gaussians(), &camera, [0.0; 3])?;
        let v_image = loss.record(&mut recorder, [side; 2], rasterizer.image(), &photograph, None)?.clone();
        let d_gaussians = plain.gaussian_gradients()?.clone();
        rasterizer.backward(&mut recorder, plain.gaussians(), &camera, &v_image, &d_gaussians)?;
        plain.backward(&mut recorder, &rows, &gradients)?;
        adam.step(&mut recorder, step, &rates, &gradients.base, &rows.base, &base)?;
        adam.step(&mut recorder, step, &rates, &gradients.bands, &rows.bands, &bands)?;
        recorder.submit()?;
        device.wait()?;
        // The first run makes buffers and kernels.
        if run > 0 {
            least = least.min(start.elapsed());
        }
        let counts = rasterizer.counts()?;
        if counts.overflowed {
            rasterizer.grow(&counts)?;
            least = Duration::MAX;
        }
    }
    Ok(least)
}

/// The rows of a shell's Gaussians, with small coefficients.
fn rows(
    shell: &tcgs::render::Gaussians,
    device: &Device,
    rng: &mut Pcg64,
) -> Result<GaussianRows, RenderError> {
    let mut rows = GaussianRows::zero(shell.capacity);
    let (geometry, colors) = (device.read(&shell.geometry)?, device.read(&shell.colors)?);
    let (means, rest) = geometry.split_at(shell.capacity);
    let (scales, quats) = rest.split_at(shell.capacity);
    for (i, row) in rows.base.chunks_exact_mut(tcgs::model::gaussian_rows::BASE).enumerate() {
        let opacity = means[i][3].min(0.99);
        row[..3].copy_from_slice(&means[i][..3]);
        row[3..6].copy_from_slice(&[0, 1, 2].map(|axis| scales[i][axis].ln()));
        row[6..10].copy_from_slice(&quats[i]);
        row[10] = (opacity / (1.0 - opacity)).ln();
        row[11..14].copy_from_slice(&colors[i][..3]);
    }
    for band in &mut rows.bands {
        band.fill_with(|| rng.random_range(-0.1..0.1));
    }
    Ok(rows)
}
