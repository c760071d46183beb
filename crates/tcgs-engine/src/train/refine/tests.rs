use glam::DVec3;

use super::*;
use crate::{
    domain::{Intrinsics, Pose},
    eval::psnr,
    gpu::testing::lavapipe,
};

/// Twelve cameras around the origin; of which the last two are not refined by.
fn cameras() -> Vec<Camera> {
    let intrinsics = Intrinsics::from_horizontal_fov(0.8, 40, 32).expect("intrinsics");
    (0..12)
        .map(|index| {
            let angle = f64::from(index) * 0.35;
            let position = DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 0.5 * f64::from(index % 3));
            let pose = Pose::look_at(position, DVec3::ZERO, DVec3::Z).expect("a view");
            Camera::new(intrinsics, pose).expect("a camera")
        })
        .collect()
}

/// A ring of Gaussians, and the same ones with other sizes, opacities and colors.
fn scenes() -> (Scene, GaussianScene) {
    let place = |index: usize| (index as f32 * 0.7).sin_cos();
    let mut sh = vec![[[0.0; 3]; 16]; 24];
    for (index, row) in sh.iter_mut().enumerate() {
        row[0] = [index as f32 / 12.0 - 1.0, 1.0 - index as f32 / 12.0, 0.5];
        row[2] = [0.3, -0.2, 0.1];
    }
    let scene = GaussianScene {
        means: (0..24).map(|index| [place(index).0, place(index).1, index as f32 / 24.0 - 0.5]).collect(),
        log_scales: vec![[-1.5, -1.7, -1.6]; 24],
        quats: vec![[1.0, 0.1, 0.0, 0.2]; 24],
        opacity_logits: vec![1.5; 24],
        sh: sh.clone(),
        degree: 1,
        ..GaussianScene::default()
    };
    sh.iter_mut().for_each(|row| row[2] = [0.0; 3]);
    let blurred = GaussianScene {
        log_scales: vec![[-1.4, -1.7, -1.5]; 24],
        opacity_logits: vec![1.2; 24],
        sh,
        ..scene.clone()
    };
    (Scene::Gaussians(scene), blurred)
}

fn refined(steps: u32) -> GaussianScene {
    let (scene, blurred) = scenes();
    let refinement =
        Refinement { scene: &scene, background: Background::White, cameras: &cameras()[..10], steps };
    let reported = std::cell::Cell::new(0);
    let refined = refinement.of(&lavapipe(), &blurred, &|step| reported.set(step)).expect("refines");
    assert_eq!(reported.get(), steps);
    refined
}

/// Mean PSNR to the scene in views that it was not refined by.
fn fidelity(gaussians: &GaussianScene) -> f64 {
    let (scene, _) = scenes();
    let [mut expected, mut found] = [scene, Scene::Gaussians(gaussians.clone())]
        .map(|scene| Renderer::of_scene(&lavapipe(), &scene, Background::White).expect("a renderer"));
    let of = |camera: &Camera| {
        let [expected, found] =
            [&mut expected, &mut found].map(|renderer| renderer.render(camera).expect("a view"));
        psnr(&expected, &found).expect("of one size")
    };
    cameras()[10..].iter().map(of).sum::<f64>() / 2.0
}

#[test]
fn unseen_views_come_nearer_and_a_second_run_gives_the_same_bits() {
    let (_, blurred) = scenes();
    let (before, once) = (fidelity(&blurred), refined(60));
    assert_eq!((once.len(), once.degree, once.frame), (blurred.len(), 1, blurred.frame));
    let after = fidelity(&once);
    println!("{before} dB before, {after} dB after");
    assert!(after > before + 2.0, "{before} dB before, {after} dB after");
    assert!(once == refined(60), "other bits");
    assert!(refined(0) == blurred, "no step changes nothing");
}
