//! What leaving out is said to cost is what it costs.

use tcgs::{
    domain::{AnchorScene, Background, Dataset, NearPlane, Scene, SceneFrame, SceneScale, Split},
    eval::{RemovalCosts, TrainView, removal_costs},
    render::Renderer,
    train::Trainer,
};

use crate::{
    support::gpu::gpu,
    train::training::{dataset, options, scaled},
};

const BACKGROUND: Background = Background::Black;

fn trained(dataset: &Dataset) -> AnchorScene {
    let trained = Trainer::new(&gpu(), dataset, &options(60, 3)).run(|_| ());
    match trained.expect("a scene").scene {
        Scene::Anchors(scene) => scene,
        Scene::Gaussians(_) => panic!("a scene of anchors"),
    }
}

fn seen(dataset: &Dataset) -> Vec<TrainView<'_>> {
    dataset.split(Split::Train).map(TrainView::from).collect()
}

fn costs(scene: &AnchorScene, views: &[TrainView<'_>]) -> RemovalCosts {
    removal_costs(&gpu(), scene, views, BACKGROUND, &mut || true).expect("measures")
}

/// Sum of squared errors of the frames, in units of the largest sample.
fn squared_error(renderer: &mut Renderer, scene: &AnchorScene, views: &[TrainView<'_>]) -> f64 {
    renderer.replace(scene).expect("the same shape");
    let of = |TrainView { frame, .. }: &TrainView<'_>| {
        let render = renderer.render(&frame.camera).expect("renders");
        let photograph = frame.image.load().expect("in memory");
        let pairs = render.samples().iter().zip(photograph.over(BACKGROUND.rgb8()).samples().to_vec());
        pairs.map(|(a, b)| ((f64::from(*a) - f64::from(b)) / 255.0).powi(2)).sum::<f64>()
    };
    views.iter().map(of).collect::<Vec<f64>>().iter().sum()
}

#[test]
fn the_cost_of_an_anchor_is_what_the_views_lose_with_it() {
    let dataset = dataset();
    let views = seen(&dataset);
    let scene = trained(&dataset);
    let costs = costs(&scene, &views);
    let mut renderer = Renderer::new(&gpu(), &scene, BACKGROUND).expect("a renderer");
    let whole = squared_error(&mut renderer, &scene, &views);
    let k = scene.offsets_per_anchor;
    let mut anchors: Vec<usize> = (0..scene.len()).collect();
    anchors.sort_by(|a, b| costs.anchors[*b].total_cmp(&costs.anchors[*a]));
    // Large ones, whose change eight bits can show.
    let mut pairs = Vec::new();
    for anchor in anchors.iter().take(24) {
        let mut without = scene.clone();
        without.masks[anchor * k..(anchor + 1) * k].fill(false);
        let lost = squared_error(&mut renderer, &without, &views) - whole;
        pairs.push((costs.anchors[*anchor], lost));
    }
    let (said, lost) = pairs.iter().fold((0.0, 0.0), |sum, pair| (sum.0 + pair.0, sum.1 + pair.1));
    assert!((0.7..1.4).contains(&(said / lost)), "{said} was said, {lost} is lost: {pairs:?}");
    let ordered = |pairs: &[(f64, f64)]| {
        let all = pairs.iter().enumerate().flat_map(|(i, a)| pairs[i + 1..].iter().map(move |b| (a, b)));
        let all: Vec<_> = all.collect();
        all.iter().filter(|(a, b)| (a.0 > b.0) == (a.1 > b.1)).count() as f64 / all.len() as f64
    };
    assert!(ordered(&pairs) > 0.75, "{} of all pairs are in order: {pairs:?}", ordered(&pairs));
}

#[test]
fn what_no_view_shows_costs_nothing_and_figures_are_repeated() {
    let dataset = dataset();
    let views = seen(&dataset);
    let mut scene = trained(&dataset);
    let k = scene.offsets_per_anchor;
    scene.masks[..k].fill(false);
    let once = costs(&scene, &views);
    assert_eq!((once.offsets.len(), once.anchors.len()), (scene.len() * k, scene.len()));
    assert!(once.offsets[..k].iter().all(|cost| *cost == 0.0) && once.anchors[0] == 0.0);
    assert_eq!(costs(&scene, &views), once);
    let none = removal_costs(&gpu(), &scene, &views, BACKGROUND, &mut || false).expect("measures");
    assert!(none.anchors.iter().all(|cost| *cost == 0.0), "stopped before the first view");
}

#[test]
fn in_a_scene_of_another_unit_leaving_out_costs_the_same() {
    let dataset = dataset();
    let mut scene = trained(&dataset);
    let expected = costs(&scene, &seen(&dataset));
    assert!(expected.anchors.iter().any(|cost| *cost > 0.1), "something costs: {expected:?}");
    // A power of two, so that every rounding is the same.
    let factor = 1.0 / 1024.0;
    let small = scaled(&dataset, f64::from(factor));
    let frame = scene.frame;
    scene.frame = SceneFrame::new(frame.offset() * f64::from(factor), frame.scale()).expect("a frame");
    scene.lattice.voxel *= factor;
    scene.lattice.origin = scene.lattice.origin.map(|coordinate| coordinate * factor);
    scene.scalings.iter_mut().for_each(|scaling| *scaling *= factor);
    scene.near = NearPlane::new(scene.near.depth() * factor).expect("a depth");
    scene.scene_scale = SceneScale::new(factor).expect("a length");
    let found = costs(&scene, &seen(&small));
    for (found, expected) in found.anchors.iter().zip(&expected.anchors) {
        assert!((found - expected).abs() < 1e-3 * (1.0 + expected.abs()), "{found} {expected}");
    }
}
