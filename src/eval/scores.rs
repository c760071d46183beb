//! Figures of single views and their means.

use serde::{Deserialize, Serialize};

use super::{psnr, ssim};
use crate::domain::{Image, Scores};

/// Quality of one view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewScore {
    /// Frame name.
    pub name: String,
    /// dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
}

impl ViewScore {
    /// Compares a render with its photograph; `None` if they are not of one shape.
    #[must_use]
    pub fn measure(name: &str, render: &Image, photograph: &Image) -> Option<Self> {
        Some(Self { name: name.to_owned(), psnr: psnr(render, photograph)?, ssim: ssim(render, photograph)? })
    }
}

/// The means over views.
#[must_use]
pub fn mean_scores(views: &[ViewScore]) -> Scores {
    let mean = |value: fn(&ViewScore) -> f64| {
        (!views.is_empty()).then(|| views.iter().map(value).sum::<f64>() / views.len() as f64)
    };
    Scores { psnr: mean(|view| view.psnr), ssim: mean(|view| view.ssim), lpips: None, views: views.len() }
}
