//! LPIPS v0.1 (Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018): the
//! distance of two images in the features of a network, on AlexNet or VGG16.
//!
//! The weights are the user's: nothing is bundled or fetched, and without weights there is no figure. Which network it is
//! follows from the shapes in the file. Images go in as values in [0, 1] scaled to [-1, 1], as the metric's authors do.
//! The same images and weights give the same bits on one machine, whatever the number of threads: every sum has an order of
//! its own, which depends on the images' size alone.
//!
//! Between stages only pooled maps are kept and each stage runs in strips, so that VGG16 takes some 300 bytes per pixel, where
//! its first maps as a whole would take 800.

mod error;
mod layout;
mod rows;
mod stage;
mod weights;

pub use error::LpipsError;

use layout::{LAYERS, StageLayout};
use rows::Rows;
use stage::LpipsStage;

use tcgs_codec::domain::{Image, LpipsNetwork, Problem};
use tcgs_engine::eval::PerceptualDistance;

/// A network with its weights, ready to compare images.
#[derive(Debug)]
pub struct Lpips {
    network: LpipsNetwork,
    /// Subtracted from inputs in [-1, 1], by channel.
    shift: [f32; 3],
    /// What inputs are then divided by.
    scale: [f32; 3],
    stages: Vec<LpipsStage>,
}

impl PerceptualDistance for Lpips {
    fn network(&self) -> LpipsNetwork {
        self.network
    }

    fn distance(&self, a: &Image, b: &Image) -> Result<f64, Problem> {
        Ok(Self::distance(self, a, b)?)
    }
}

impl Lpips {
    /// Reads the weights from the bytes of a safetensors file.
    ///
    /// Convolutions are named as torchvision does (`features.0.weight`) or as the `lpips` package does
    /// (`net.slice1.0.weight`), the heads as the `lpips` package does (`lin0.model.1.weight`). Everything is f32. Other
    /// tensors in the file, such as a classifier, are not read.
    ///
    /// # Errors
    /// [`LpipsError`] names the tensor that is missing or not as it must be.
    pub fn from_safetensors(bytes: &[u8]) -> Result<Self, LpipsError> {
        weights::read(bytes)
    }

    /// The network that the weights are of.
    #[must_use]
    pub fn network(&self) -> LpipsNetwork {
        self.network
    }

    /// The distance of two RGB images of one size: 0 for equal ones, below 1 for most.
    ///
    /// # Errors
    /// Those of [`Lpips::layers`].
    pub fn distance(&self, a: &Image, b: &Image) -> Result<f64, LpipsError> {
        Ok(self.layers(a, b)?.iter().sum())
    }

    /// The part of the distance that comes from each of the five layers, the first layer first: the mean over positions of
    /// the weighted squared differences of features with unit length.
    ///
    /// # Errors
    /// [`LpipsError::NotComparable`] unless both images are RGB and of one size, [`LpipsError::TooSmall`] for images that the
    /// network's pooling leaves nothing of, [`LpipsError::Overflow`] for weights that lead beyond f32.
    pub fn layers(&self, a: &Image, b: &Image) -> Result<[f64; LAYERS], LpipsError> {
        let same = a.width() == b.width() && a.height() == b.height();
        if !same || a.channels() != 3 || b.channels() != 3 {
            return Err(LpipsError::NotComparable);
        }
        self.check_size(a.width(), a.height())?;
        let mut maps = [self.input(a), self.input(b)];
        let mut layers = [0.0; LAYERS];
        for (stage, layer) in self.stages.iter().zip(&mut layers) {
            (*layer, maps) = stage.compare(&maps);
            if !layer.is_finite() {
                return Err(LpipsError::Overflow);
            }
        }
        Ok(layers)
    }

    /// Whether images of a size can be compared.
    ///
    /// # Errors
    /// [`LpipsError::TooSmall`].
    pub fn check_size(&self, width: u32, height: u32) -> Result<(), LpipsError> {
        let stages = layout::stages(self.network);
        let fits = |side: u32| deepest(stages, side as usize) > 0;
        if fits(width) && fits(height) {
            return Ok(());
        }
        let min = (1..).find(|side| fits(*side)).unwrap_or(u32::MAX);
        Err(LpipsError::TooSmall { network: self.network, width, height, min })
    }

    fn input(&self, image: &Image) -> Rows {
        let values = image
            .samples()
            .iter()
            .enumerate()
            .map(|(index, value)| {
                let channel = index % 3;
                (f32::from(*value) / 255.0 * 2.0 - 1.0 - self.shift[channel]) / self.scale[channel]
            })
            .collect();
        Rows::whole(image.width() as usize, image.height() as usize, 3, values)
    }
}

/// The side of the last layer's map for images of a side; 0 if nothing is left.
fn deepest(stages: &[StageLayout], side: usize) -> usize {
    let windows = stages.iter().flat_map(|stage| {
        stage.convolutions.iter().map(|convolution| convolution.window).chain([stage.pool])
    });
    windows.fold(side, |side, window| window.outputs(side))
}
