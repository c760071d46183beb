//! Cases of the optimizer: steps after long rests, with moments that have all but vanished.

use std::sync::Arc;

use super::{
    case::{Bound, Case, Errors},
    error::CaseError,
    norms::largest,
};
use tcgs_engine::train::{
    Adam, AdamStep, Moments,
    twin::{AdamElement, adam},
};
use tcgs_render::gpu::Device;

const VALUES: &str = "values, largest difference in learning rates";
const SECOND: &str = "second moments, largest relative difference";

/// The cases.
pub(super) const CASES: &[Case] = &[
    Case {
        name: "adam-after-zero-gradients",
        bounds: &[
            Bound {
                quantity: VALUES,
                largest: 2e-4,
                why: "a value of one has a rounding of 6e-8, which is 6e-6 of the learning rate, in each of the ten steps that move it",
            },
            Bound {
                quantity: SECOND,
                largest: 2e-4,
                why: "a chain of 2000 products by 0.999, which f32 has to 2e-8, each rounded by up to 6e-8",
            },
        ],
        measure: after_zero_gradients,
    },
    Case {
        name: "adam-vanished-moments",
        bounds: &[Bound {
            quantity: VALUES,
            largest: 1e-4,
            why: "moments below 1e-38 may count as zero; epsilon is far larger than their roots",
        }],
        measure: vanished_moments,
    },
];

const RATE: f32 = 0.01;

/// Steps on both sides; element i begins at `elements[i]` and has the gradient `gradient(step, i)`.
fn compare(
    device: &Arc<Device>,
    mut elements: Vec<AdamElement>,
    steps: std::ops::RangeInclusive<u32>,
    gradient: impl Fn(u32, usize) -> f32,
) -> Result<Errors, CaseError> {
    let kernel = Adam::new(device)?;
    let part = |of: fn(&AdamElement) -> f64| -> Vec<f32> { elements.iter().map(|e| of(e) as f32).collect() };
    let values = device.upload("values", &part(|e| e.value))?;
    let moments = Moments::upload(device, &part(|e| e.first), &part(|e| e.second))?;
    let rates = device.upload("rates", &[RATE])?;
    let no = device.upload("overflow flag", &[0_u32])?;
    let mut held: Option<(Vec<f32>, tcgs_render::gpu::Buffer<f32>)> = None;
    let mut recorder = device.recorder("adam");
    for number in steps {
        let gradients: Vec<f32> = (0..elements.len()).map(|i| gradient(number, i)).collect();
        for (element, gradient) in elements.iter_mut().zip(&gradients) {
            *element = adam(*element, number, f64::from(RATE), f64::from(*gradient));
        }
        // Long rests have the same gradients over and over.
        let buffer = match &held {
            Some((same, buffer)) if *same == gradients => buffer.clone(),
            _ => {
                let buffer = device.upload("gradients", &gradients)?;
                held = Some((gradients, buffer.clone()));
                buffer
            }
        };
        let step = AdamStep { number, overflow_flag: &no };
        kernel.step(&mut recorder, step, &rates, &buffer, &values, &moments)?;
        if number % 100 == 0 {
            recorder.submit()?;
            recorder = device.recorder("adam");
        }
    }
    recorder.submit()?;
    let (values, second) = (device.read(&values)?, device.read(&moments.second)?);
    let values = elements.iter().zip(&values).map(|(e, v)| (f64::from(*v) - e.value).abs() / f64::from(RATE));
    let second = elements.iter().zip(&second).map(|(e, v)| (f64::from(*v) / e.second - 1.0).abs());
    Ok(vec![(VALUES, largest(values)), (SECOND, largest(second))])
}

/// Gradients from 1e-9 to 1e3, then two thousand of zero, after which nothing of the first moment is left, then others.
fn after_zero_gradients(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let elements =
        (0..12).map(|i| AdamElement { value: f64::from(i) * 0.125 - 0.75, ..AdamElement::default() });
    compare(device, elements.collect(), 1..=2010, |step, i| match step {
        1..=5 | 2006.. => 10_f32.powi(i as i32 - 8) * if step % 2 == 0 { 1.0 } else { -0.5 },
        _ => 0.0,
    })
}

/// Moments at and below the least normal number, then gradients of every size.
fn vanished_moments(device: &Arc<Device>) -> Result<Errors, CaseError> {
    let moments = [0.0, 1e-45, 1e-40, 1e-38, 1e-30];
    let elements = (0..20).map(|i| AdamElement {
        value: 0.5,
        first: f64::from(moments[i % 5] as f32),
        second: f64::from(moments[i / 5 % 5] as f32),
    });
    compare(device, elements.collect(), 100_000..=100_003, |_, i| [0.0, 1e-18, 1e-12, 1.0, 1e9][i % 5])
}
