//! The optimizer on the device against its twin, and gradients that are none.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tcgs::train::{
    Adam, AdamStep, Moments,
    twin::{self, AdamElement},
};

use crate::support::gpu::gpu;

#[test]
fn adam_follows_its_twin() {
    const COUNT: usize = 130;
    let device = gpu();
    let mut rng = Pcg64::seed_from_u64(8);
    let rates = [1e-2_f32, 5e-3, 0.1, 1e-4];
    let values: Vec<f32> = (0..COUNT).map(|_| rng.random_range(-1.0..1.0)).collect();
    let mut expected: Vec<AdamElement> =
        values.iter().map(|v| AdamElement { value: f64::from(*v), ..AdamElement::default() }).collect();
    let adam = Adam::new(&device).expect("the kernel");
    let no = device.upload("overflow flag", &[0]).expect("a buffer");
    let values = device.upload("values", &values).expect("room");
    let moments = Moments::plan(COUNT).make(&device).expect("room");
    let table = device.upload("rates", &rates).expect("room");
    for t in 1..=30 {
        // Magnitudes from 1e-9 to 1e3; element 0 rests at zero.
        let gradients: Vec<f32> = (0..COUNT)
            .map(
                |i| if i == 0 { 0.0 } else { rng.random_range(-1.0..1.0) * 10_f32.powi((i % 13) as i32 - 9) },
            )
            .collect();
        for (i, (element, gradient)) in expected.iter_mut().zip(&gradients).enumerate() {
            *element = twin::adam(*element, t, f64::from(rates[i % 4]), f64::from(*gradient));
        }
        let gradients = device.upload("gradients", &gradients).expect("room");
        let mut recorder = device.recorder("adam");
        adam.step(
            &mut recorder,
            AdamStep { number: t, overflow_flag: &no },
            &table,
            &gradients,
            &values,
            &moments,
        )
        .expect("recorded");
        recorder.submit().expect("submitted");
    }
    let found = [&values, &moments.first, &moments.second].map(|buffer| device.read(buffer).expect("read"));
    for (i, element) in expected.iter().enumerate() {
        let [value, first, second] = [0, 1, 2].map(|part| f64::from(found[part][i]));
        // Thirty steps of at most 0.1 with a rounding of 6e-8 and a root good to a few units more.
        assert!((value - element.value).abs() < 3e-6, "value {i}: {value} {}", element.value);
        let scale = element.second.sqrt();
        assert!((first - element.first).abs() <= 1e-5 * scale, "first {i}: {first} {}", element.first);
        assert!((second - element.second).abs() <= 1e-5 * element.second, "second {i}: {second}");
    }
    assert_eq!(found[1][0].to_bits(), 0, "no gradient, no motion");
}

#[test]
fn the_first_step_of_adam_is_the_rate_whatever_the_gradient() {
    for gradient in [1e-6, -1e-6, 3.0, -1e4] {
        let moved = twin::adam(AdamElement::default(), 1, 0.01, gradient);
        assert!((moved.value + 0.01 * gradient.signum()).abs() < 1e-9, "{gradient}: {}", moved.value);
    }
}

#[test]
fn a_gradient_that_is_not_finite_leaves_its_element_untouched_and_alone() {
    let device = gpu();
    let adam = Adam::new(&device).expect("the kernel");
    let no = device.upload("overflow flag", &[0]).expect("a buffer");
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e20, -1e38, 1.0];
    let values = device.upload("values", &[0.5_f32; 6]).expect("room");
    let moments = Moments::upload(&device, &[0.25; 6], &[0.125; 6]).expect("room");
    let rates = device.upload("rates", &[0.01_f32]).expect("room");
    let gradients = device.upload("gradients", &bad).expect("room");
    let mut recorder = device.recorder("adam");
    adam.step(
        &mut recorder,
        AdamStep { number: 1, overflow_flag: &no },
        &rates,
        &gradients,
        &values,
        &moments,
    )
    .expect("recorded");
    recorder.submit().expect("submitted");
    assert_eq!(device.read(&values).expect("read")[..5], [0.5; 5]);
    assert_eq!(device.read(&moments.first).expect("read")[..5], [0.25; 5]);
    assert_eq!(device.read(&moments.second).expect("read")[..5], [0.125; 5]);
    assert!(device.read(&values).expect("read")[5] < 0.5, "the others learn");
    // What was spared is not spoiled: the next gradient moves every element.
    let gradients = device.upload("gradients", &[1.0_f32; 6]).expect("room");
    let mut recorder = device.recorder("adam");
    adam.step(
        &mut recorder,
        AdamStep { number: 2, overflow_flag: &no },
        &rates,
        &gradients,
        &values,
        &moments,
    )
    .expect("recorded");
    recorder.submit().expect("submitted");
    assert!(device.read(&values).expect("read").iter().all(|v| *v < 0.5));
}

#[test]
fn a_void_step_changes_nothing() {
    let device = gpu();
    let adam = Adam::new(&device).expect("the kernel");
    let values = device.upload("values", &[0.5_f32; 6]).expect("room");
    let moments = Moments::upload(&device, &[0.25; 6], &[0.125; 6]).expect("room");
    let [rates, gradients] = [0.01_f32, 1.0].map(|v| device.upload("input", &[v; 6]).expect("room"));
    let mark = device.upload("overflow flag", &[77_u32]).expect("a buffer");
    let mut recorder = device.recorder("adam");
    adam.step(
        &mut recorder,
        AdamStep { number: 1, overflow_flag: &mark },
        &rates,
        &gradients,
        &values,
        &moments,
    )
    .expect("recorded");
    recorder.submit().expect("submitted");
    for (buffer, untouched) in [(&values, 0.5), (&moments.first, 0.25), (&moments.second, 0.125)] {
        assert_eq!(device.read(buffer).expect("read"), [untouched; 6]);
    }
}

#[test]
fn what_is_behind_the_last_element_does_not_learn() {
    const COUNT: usize = 8;
    for elements in 4..=COUNT {
        let device = gpu();
        let adam = Adam::new(&device).expect("the kernel");
        let no = device.upload("overflow flag", &[0]).expect("a buffer");
        let values = device.upload("values", &[0.5_f32; COUNT]).expect("room");
        let gradients = device.upload("gradients", &[1.0_f32; COUNT]).expect("room");
        let moments = Moments::plan(COUNT).make(&device).expect("room");
        let rates = device.upload("rates", &[0.1_f32]).expect("room");
        let step = AdamStep { number: 1, overflow_flag: &no };
        let mut recorder = device.recorder("adam");
        adam.step(&mut recorder, step, &rates, &gradients, &values.first(elements), &moments)
            .expect("recorded");
        recorder.submit().expect("submitted");
        let found =
            [&values, &moments.first, &moments.second].map(|buffer| device.read(buffer).expect("read"));
        assert!(found[0][..elements].iter().all(|value| (value - 0.4).abs() < 1e-6), "{found:?}");
        assert_eq!(found[0][elements..], vec![0.5; COUNT - elements], "of {elements}");
        assert!(found[1..].iter().all(|moment| moment[elements..].iter().all(|value| *value == 0.0)));
    }
}

#[test]
fn every_element_learns_at_its_own_rate() {
    let device = gpu();
    let adam = Adam::new(&device).expect("the kernel");
    let no = device.upload("overflow flag", &[0]).expect("a buffer");
    // The kernel steps four neighbors at a time: tables shorter than that, and lengths that it does not divide.
    for rates in [&[0.1_f32][..], &[0.1, 0.2], &[0.1, 0.2, 0.3], &[0.1, 0.2, 0.3, 0.4, 0.5]] {
        for count in [1, 4, 7, 600] {
            let values = device.upload("values", &vec![0.0_f32; count]).expect("room");
            let gradients = device.upload("gradients", &vec![1.0_f32; count]).expect("room");
            let table = device.upload("rates", rates).expect("room");
            let moments = Moments::plan(count).make(&device).expect("room");
            let mut recorder = device.recorder("adam");
            adam.step(
                &mut recorder,
                AdamStep { number: 1, overflow_flag: &no },
                &table,
                &gradients,
                &values,
                &moments,
            )
            .expect("recorded");
            recorder.submit().expect("submitted");
            for (i, (value, rate)) in
                device.read(&values).expect("read").iter().zip(rates.iter().cycle()).enumerate()
            {
                assert!((value + rate).abs() < 1e-6, "{count} elements, {rates:?}: {i} moved by {value}");
            }
        }
    }
}
