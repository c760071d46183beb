//! Keeps the Gaussians that the views show most, for viewers with a limit on their number.
//!
//! A Gaussian counts by the light that it adds: opacity times the transmittance in front of it times its area in pixels, summed over the
//! views. Its color does not count, since a dark Gaussian hides others as a bright one does.

use std::f64::consts::TAU;

use glam::DVec3;
use rayon::prelude::*;

use super::bake::{BakeView, Disc, VIEWS_AT_ONCE, shares, thinned};
use crate::domain::{Camera, GaussianScene};

/// The `count` Gaussians that `cameras`, which are in the world, show most, in the scene's order.
#[must_use]
pub fn limited(scene: &GaussianScene, cameras: &[Camera], count: usize) -> GaussianScene {
    if scene.len() <= count {
        return scene.clone();
    }
    let shown = contributions(scene, cameras);
    let mut kept: Vec<usize> = (0..scene.len()).collect();
    kept.sort_by(|a, b| shown[*b].total_cmp(&shown[*a]).then(a.cmp(b)));
    kept.truncate(count);
    kept.sort_unstable();
    scene.with_only(&kept)
}

/// Light of each Gaussian in all views, in pixels.
fn contributions(scene: &GaussianScene, cameras: &[Camera]) -> Vec<f64> {
    let opacities: Vec<f32> = scene.opacity_logits.iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect();
    let disc = |(mean, log): (&[f32; 3], &[f32; 3])| {
        let mut log = log.map(f64::from);
        log.sort_unstable_by(f64::total_cmp);
        Disc { mean: DVec3::from(mean.map(f64::from)), sigma: (f64::midpoint(log[1], log[2])).exp() }
    };
    let discs: Vec<Disc> = scene.means.iter().zip(&scene.log_scales).map(disc).collect();
    let near = f64::from(scene.near.depth());
    let of_view = |camera: &Camera| -> Vec<f64> {
        let view = BakeView::of(&scene.frame.camera_from_world(camera));
        let shares = shares(&view, &discs, &opacities, near);
        let (width, height) = view.size();
        let shown = |(index, disc): (usize, &Disc)| match view.project(disc.mean, near) {
            Some((.., scale)) if view.sees(disc.mean, disc.sigma, near) => {
                let area = (TAU * (scale * disc.sigma).powi(2)).min(width * height);
                area * f64::from(opacities[index] * shares[index])
            }
            _ => 0.0,
        };
        discs.iter().enumerate().map(shown).collect()
    };
    summed(&thinned(cameras), scene.len(), of_view)
}

/// The sums of the `count` values of each view. They are added in the order of the views, so that the sums are the same with any number of
/// threads.
fn summed<V: Sync, I>(views: &[V], count: usize, of_view: impl Fn(&V) -> I + Sync) -> Vec<f64>
where
    I: IntoIterator<Item = f64> + Send,
{
    let mut sums = vec![0.0; count];
    for block in views.chunks(VIEWS_AT_ONCE) {
        let values: Vec<I> = block.par_iter().map(&of_view).collect();
        for view in values {
            sums.iter_mut().zip(view).for_each(|(sum, value)| *sum += value);
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::export::bake::sphere;

    /// Values of a view that count themselves while they are in memory.
    struct Counted<'a> {
        values: std::vec::IntoIter<f64>,
        alive: &'a AtomicUsize,
    }

    impl Iterator for Counted<'_> {
        type Item = f64;

        fn next(&mut self) -> Option<f64> {
            self.values.next()
        }
    }

    impl Drop for Counted<'_> {
        fn drop(&mut self) {
            self.alive.fetch_sub(1, Ordering::SeqCst);
        }
    }

    #[test]
    fn values_of_few_views_are_in_memory_and_sums_have_the_order_of_the_views() {
        let views: Vec<u32> = (0..101).collect();
        let of_view = |view: &u32| (0..5).map(|index| f64::from(view * 7 + index).sin()).collect::<Vec<_>>();
        let (alive, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let found = summed(&views, 5, |view| {
            most.fetch_max(alive.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            Counted { values: of_view(view).into_iter(), alive: &alive }
        });
        let mut expected = vec![0.0; 5];
        for view in &views {
            expected.iter_mut().zip(of_view(view)).for_each(|(sum, value)| *sum += value);
        }
        assert_eq!(found, expected);
        assert!(most.into_inner() <= VIEWS_AT_ONCE);
    }

    #[test]
    fn what_is_seen_most_is_kept_in_order() {
        // Large, hidden inside it, small beside it, and faint.
        let scene = GaussianScene {
            means: vec![[0.0; 3], [0.0, 0.0, 0.01], [3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]],
            log_scales: vec![[0.0; 3], [-3.0; 3], [-2.0; 3], [-2.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 4],
            opacity_logits: vec![9.0, 9.0, 9.0, -5.0],
            sh: vec![[[0.0; 3]; 16]; 4],
            degree: 0,
            ..GaussianScene::default()
        };
        let cameras = sphere(&scene.means, 12, 64).expect("cameras");
        assert_eq!(limited(&scene, &cameras, 2).means, [[0.0; 3], [3.0, 0.0, 0.0]]);
        assert_eq!(limited(&scene, &cameras, 1).means, [[0.0; 3]]);
        assert_eq!(limited(&scene, &cameras, 4), scene);
    }
}
