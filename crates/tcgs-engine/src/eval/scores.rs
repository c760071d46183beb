//! Scores of single views and their means.

use super::{psnr, ssim};
use crate::domain::{Image, LpipsNetwork, Scores, ViewScore};

/// Compares a render with its photograph by PSNR and SSIM; `None` if they are not of one shape.
#[must_use]
pub fn score_view(name: &str, render: &Image, photograph: &Image) -> Option<ViewScore> {
    let (psnr, ssim) = rayon::join(|| psnr(render, photograph), || ssim(render, photograph));
    Some(ViewScore { name: name.to_owned(), psnr: psnr?, ssim: ssim?, lpips: None })
}

/// The means of PSNR and SSIM over views, with the views.
#[must_use]
pub fn mean_scores(views: &[ViewScore]) -> Scores {
    mean_scores_with(views, None)
}

/// The means over views, with the views; `network` is the one that LPIPS was measured on.
///
/// There is a mean of LPIPS only if every view has a figure: a mean over some would be taken for one over all.
#[must_use]
pub fn mean_scores_with(views: &[ViewScore], network: Option<LpipsNetwork>) -> Scores {
    let mean = |value: fn(&ViewScore) -> Option<f64>| {
        let sum: Option<f64> = views.iter().map(value).sum();
        sum.filter(|_| !views.is_empty()).map(|sum| sum / views.len() as f64)
    };
    let lpips = network.and_then(|_| mean(|view| view.lpips));
    Scores {
        psnr: mean(|view| Some(view.psnr)),
        ssim: mean(|view| Some(view.ssim)),
        lpips,
        lpips_network: network.filter(|_| lpips.is_some()),
        views: views.len(),
        per_view: views.to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(psnr: f64, lpips: Option<f64>) -> ViewScore {
        ViewScore { name: "a view".to_owned(), psnr, ssim: 0.5, lpips }
    }

    #[test]
    fn means_are_over_views() {
        let scores =
            mean_scores_with(&[view(20.0, Some(0.1)), view(30.0, Some(0.3))], Some(LpipsNetwork::Vgg));
        assert_eq!((scores.psnr, scores.ssim, scores.views), (Some(25.0), Some(0.5), 2));
        assert_eq!((scores.lpips, scores.lpips_network), (Some(0.2), Some(LpipsNetwork::Vgg)));
        assert_eq!(scores.per_view.len(), 2);
    }

    #[test]
    fn no_views_have_no_mean() {
        let scores = mean_scores_with(&[], Some(LpipsNetwork::Alex));
        assert_eq!((scores.psnr, scores.lpips, scores.lpips_network, scores.views), (None, None, None, 0));
        assert_eq!(mean_scores(&[view(20.0, None)]).psnr, Some(20.0));
    }

    #[test]
    fn a_view_without_lpips_leaves_the_mean_without() {
        let scores = mean_scores_with(&[view(20.0, Some(0.1)), view(30.0, None)], Some(LpipsNetwork::Vgg));
        assert_eq!((scores.psnr, scores.lpips, scores.lpips_network), (Some(25.0), None, None));
    }
}
