//! The f64 twin's gradients against central differences of its own forward pass.

use glam::{DVec3, DVec4};
use tcgs_render::{
    Projection, RasterSettings,
    twin::{self, Cutoffs, Gaussian, GaussianGradient},
};

use crate::support::random;

/// No cut-offs, so that the loss has no jumps.
const SMOOTH: Cutoffs = Cutoffs { alpha: 1e-13, transmittance: 0.0 };

fn parameters(g: &Gaussian) -> [f64; 14] {
    let ([mx, my, mz], [sx, sy, sz], [r, gr, b]) =
        (g.mean.to_array(), g.scale.to_array(), g.color.to_array());
    let [w, x, y, z] = g.quat;
    [mx, my, mz, sx, sy, sz, r, gr, b, w, x, y, z, g.opacity]
}

fn from_parameters(p: [f64; 14]) -> Gaussian {
    Gaussian {
        mean: DVec3::new(p[0], p[1], p[2]),
        scale: DVec3::new(p[3], p[4], p[5]),
        color: DVec3::new(p[6], p[7], p[8]),
        quat: [p[9], p[10], p[11], p[12]],
        opacity: p[13],
    }
}

fn gradient(v: &GaussianGradient) -> [f64; 14] {
    let quat = v.quat;
    let as_gaussian = Gaussian { mean: v.mean, opacity: v.opacity, scale: v.scale, quat, color: v.color };
    parameters(&as_gaussian)
}

fn check(settings: RasterSettings, change: impl Fn(&mut Gaussian)) {
    let camera = random::camera(21, 18);
    let projection = Projection::new(&camera, &settings);
    let background = DVec3::new(0.3, 0.6, 0.1);
    let d_image: Vec<[f64; 4]> =
        random::d_image(3, 21 * 18).iter().map(|pixel| pixel.map(f64::from)).collect();
    let mut gaussians = random::gaussians(7, 12, 0.5);
    gaussians.iter_mut().for_each(&change);
    let loss = |gaussians: &[Gaussian]| -> f64 {
        let rendering = twin::forward(&projection, gaussians, background, SMOOTH);
        let image = rendering.frame.image.iter().zip(&d_image);
        image.map(|(p, v)| p[0] * v[0] + p[1] * v[1] + p[2] * v[2] + (1.0 - p[3]) * v[3]).sum()
    };
    let rendering = twin::forward(&projection, &gaussians, background, SMOOTH);
    assert!(rendering.splats.iter().all(Option::is_some), "the scene must be in view");
    let (_, found) = twin::backward(&projection, &gaussians, &rendering, &d_image, SMOOTH);
    for i in 0..gaussians.len() {
        for k in 0..14 {
            let step = 1e-6;
            let moved = |by: f64| {
                let mut moved = gaussians.clone();
                let mut p = parameters(&gaussians[i]);
                p[k] += by;
                moved[i] = from_parameters(p);
                loss(&moved)
            };
            let expected = (moved(step) - moved(-step)) / (2.0 * step);
            let found = gradient(&found[i])[k];
            // Central differences of a sum of about a hundred with this step are good to 1e-8 absolute.
            assert!(
                (found - expected).abs() <= 1e-6 * (1.0 + expected.abs()),
                "Gaussian {i} parameter {k}: {found} instead of {expected}"
            );
        }
    }
}

/// Red, green, blue and a weight of 0 or 1 a pixel.
fn photograph(pixels: usize) -> Vec<[f64; 4]> {
    random::d_image(11, pixels)
        .iter()
        .enumerate()
        .map(|(i, [r, g, b, _])| {
            let [r, g, b] = [r, g, b].map(|value| f64::from(value.abs().min(1.0)));
            [r, g, b, if i % 7 == 0 { 0.0 } else { 1.0 }]
        })
        .collect()
}

/// Darker, with channels that mix and one that has nothing of itself but a constant.
const CORRECTION: [DVec4; 3] =
    [DVec4::new(0.5, 0.1, -0.2, 0.05), DVec4::new(0.0, 1.4, 0.1, -0.1), DVec4::new(0.3, 0.2, 0.0, 0.1)];

#[test]
fn the_removal_loss_is_the_change_of_the_error_without_the_gaussian() {
    removal_losses_are_changes_of_the_error(None);
}

#[test]
fn with_a_correction_it_is_that_of_the_corrected_error() {
    removal_losses_are_changes_of_the_error(Some(&CORRECTION));
}

fn removal_losses_are_changes_of_the_error(correction: Option<&[DVec4; 3]>) {
    let camera = random::camera(21, 18);
    let projection = Projection::new(&camera, &RasterSettings::default());
    let background = DVec3::new(0.3, 0.6, 0.1);
    let mut gaussians = random::gaussians(7, 12, 0.5);
    // One is opaque, and one is hidden by it in part.
    gaussians[3].opacity = 0.98;
    let photograph = photograph(21 * 18);
    let error = |gaussians: &[Gaussian]| -> f64 {
        let image = twin::forward(&projection, gaussians, background, SMOOTH).frame.image;
        let seen = |p: &[f64; 4]| {
            let color = DVec4::new(p[0], p[1], p[2], 1.0);
            correction.map_or([p[0], p[1], p[2]], |rows| rows.map(|row| row.dot(color)))
        };
        let pixels = image.iter().map(seen).zip(&photograph);
        pixels.map(|(p, w)| w[3] * (0..3).map(|c| (p[c] - w[c]).abs()).sum::<f64>()).sum()
    };
    let rendering = twin::forward(&projection, &gaussians, background, SMOOTH);
    let mut found = vec![0.0; gaussians.len()];
    let slots = twin::removal_loss(&projection, &rendering, &photograph, correction, SMOOTH);
    for (slot, loss) in slots.iter().enumerate() {
        found[rendering.lists.slot_ids[slot] as usize] += loss;
    }
    for i in 0..gaussians.len() {
        let mut without = gaussians.clone();
        without[i].opacity = 0.0;
        let expected = error(&without) - error(&gaussians);
        assert!(
            (found[i] - expected).abs() <= 1e-9 * (1.0 + expected.abs()),
            "Gaussian {i}: {} instead of {expected}",
            found[i]
        );
    }
}

#[test]
fn gradients_are_those_of_the_forward_pass() {
    check(RasterSettings::default(), |g| g.opacity *= 0.9);
}

#[test]
fn gradients_of_antialiased_rendering_are_exact() {
    let settings = RasterSettings { antialiased: true, ..RasterSettings::default() };
    check(settings, |g| g.opacity *= 0.9);
}

#[test]
fn gradients_are_exact_where_opacity_is_clamped() {
    // Above 0.99 around the center, below further out.
    check(RasterSettings::default(), |g| g.opacity = 1.4);
}

#[test]
fn gradients_are_exact_where_the_jacobian_is_clamped() {
    // Large Gaussians beside the view, whose centers lie beyond the clamp.
    check(RasterSettings::default(), |g| {
        g.mean = g.mean * 0.5 + DVec3::new(1.6, 2.4, 0.0);
        g.scale = g.scale * 2.0 + 0.5;
        g.opacity *= 0.9;
    });
}
