//! How reported image quality is measured, in words that are stored with the figures.
//!
//! A figure without its convention cannot be compared: each of the choices below moves published numbers by a tenth of a
//! dB or more, and LPIPS on AlexNet is a third to a half of LPIPS on VGG (METHOD.md §1.2).

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{HoldOut, choice::named_choice};

named_choice! {
    /// The network that LPIPS compares features of; the figures of two networks cannot be compared.
    pub enum LpipsNetwork {
        /// AlexNet in torchvision's layout.
        Alex = "lpips-alex",
        /// VGG16 in torchvision's layout.
        Vgg = "lpips-vgg",
    }
}

/// How the figures beside it were measured.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Conventions {
    /// Which images are compared.
    pub images: String,
    /// PSNR.
    pub psnr: String,
    /// SSIM.
    pub ssim: String,
    /// LPIPS with its network, or null if it was not measured.
    pub lpips: Option<String>,
    /// Which views are held out.
    pub held_out: String,
    /// What is averaged.
    pub means: String,
}

impl Conventions {
    /// The conventions of every figure that this program reports, LPIPS on `network` if it was measured.
    #[must_use]
    pub fn new(network: Option<LpipsNetwork>) -> Self {
        Self {
            images: "decoded scene as 8-bit RGB, photograph composited on the same background".to_owned(),
            psnr: "dB, squared error pooled over pixels and the three channels, at most 100".to_owned(),
            ssim: "11x11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels".to_owned(),
            lpips: network.map(|network| format!("{network}-v0.1, inputs scaled to [-1, 1], spatial mean")),
            held_out: HoldOut::Auto.convention().to_owned(),
            means: "over views, of each view's figure".to_owned(),
        }
    }
}

impl Conventions {
    /// Of figures of views that are held out so.
    #[must_use]
    pub fn of(self, holdout: HoldOut) -> Self {
        Self { held_out: holdout.convention().to_owned(), ..self }
    }
}

/// Those of figures without LPIPS.
impl Default for Conventions {
    fn default() -> Self {
        Self::new(None)
    }
}

impl fmt::Display for Conventions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { images, psnr, ssim, lpips, held_out, means } = self;
        let lpips = lpips.as_deref().unwrap_or("not measured, no weights");
        write!(
            f,
            "Images: {images}. PSNR: {psnr}. SSIM: {ssim}. LPIPS: {lpips}. Held out: {held_out}. Means: {means}."
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_network_is_part_of_the_metrics_name() {
        for network in [LpipsNetwork::Alex, LpipsNetwork::Vgg] {
            let written = serde_json::to_value(network).expect("JSON");
            assert_eq!(written, network.name());
            let stated = Conventions::new(Some(network));
            assert!(
                stated
                    .lpips
                    .as_ref()
                    .is_some_and(|text| text.starts_with(&format!("{}-v0.1,", network.name())))
            );
            assert!(stated.to_string().contains(network.name()));
        }
        assert_eq!(Conventions::default().lpips, None);
    }

    #[test]
    fn each_convention_is_a_sentence() {
        let stated = Conventions::default().to_string();
        let sentences: Vec<_> = stated.split_inclusive(". ").collect();
        assert_eq!(sentences.len(), 6, "{stated}");
        assert!(sentences.iter().all(|sentence| sentence.starts_with(char::is_uppercase)), "{stated}");
        assert!(stated.ends_with('.'), "{stated}");
    }
}
