//! The two networks: torchvision's AlexNet and VGG16, cut after the ReLUs whose features LPIPS compares.

use std::ops::Range;

use tcgs_codec::domain::LpipsNetwork;

/// Layers whose features are compared.
pub(super) const LAYERS: usize = 5;

/// The LPIPS scaling layer's constants, in RGB order, for inputs in [-1, 1].
pub(super) const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
/// See [`SHIFT`].
pub(super) const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// Where a convolution or a pooling looks, the same along both axes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Window {
    pub(super) size: usize,
    pub(super) stride: usize,
    /// Zeros before the first and after the last position.
    pub(super) padding: usize,
}

impl Window {
    /// Outputs along an axis of `inputs` positions; 0 if the window does not fit.
    pub(super) fn outputs(self, inputs: usize) -> usize {
        (inputs + 2 * self.padding).checked_sub(self.size).map_or(0, |free| free / self.stride + 1)
    }

    /// The positions, of `inputs`, that the outputs `outputs` look at; `outputs` is not empty.
    pub(super) fn sources(self, outputs: &Range<usize>, inputs: usize) -> Range<usize> {
        let start = (outputs.start * self.stride).saturating_sub(self.padding);
        let end = ((outputs.end - 1) * self.stride + self.size).saturating_sub(self.padding);
        start..end.min(inputs)
    }
}

/// A convolution and the ReLU after it.
#[derive(Debug, Clone, Copy)]
pub(super) struct ConvolutionLayout {
    /// Its index in torchvision's `features`.
    pub(super) index: usize,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) window: Window,
}

/// What leads from one compared layer to the next.
#[derive(Debug, Clone, Copy)]
pub(super) struct StageLayout {
    pub(super) convolutions: &'static [ConvolutionLayout],
    /// The pooling between the compared layer and the next stage.
    pub(super) pool: Window,
}

/// A pooling that changes nothing.
const NONE: Window = Window { size: 1, stride: 1, padding: 0 };
const POOL_ALEX: Window = Window { size: 3, stride: 2, padding: 0 };
const POOL_VGG: Window = Window { size: 2, stride: 2, padding: 0 };

const fn convolution(
    index: usize,
    inputs: usize,
    outputs: usize,
    size: usize,
    stride: usize,
    padding: usize,
) -> ConvolutionLayout {
    ConvolutionLayout { index, inputs, outputs, window: Window { size, stride, padding } }
}

/// A convolution as all of VGG's are.
const fn same(index: usize, inputs: usize, outputs: usize) -> ConvolutionLayout {
    convolution(index, inputs, outputs, 3, 1, 1)
}

const ALEX: [StageLayout; LAYERS] = [
    StageLayout { convolutions: &[convolution(0, 3, 64, 11, 4, 2)], pool: POOL_ALEX },
    StageLayout { convolutions: &[convolution(3, 64, 192, 5, 1, 2)], pool: POOL_ALEX },
    StageLayout { convolutions: &[same(6, 192, 384)], pool: NONE },
    StageLayout { convolutions: &[same(8, 384, 256)], pool: NONE },
    StageLayout { convolutions: &[same(10, 256, 256)], pool: NONE },
];

const VGG: [StageLayout; LAYERS] = [
    StageLayout { convolutions: &[same(0, 3, 64), same(2, 64, 64)], pool: POOL_VGG },
    StageLayout { convolutions: &[same(5, 64, 128), same(7, 128, 128)], pool: POOL_VGG },
    StageLayout {
        convolutions: &[same(10, 128, 256), same(12, 256, 256), same(14, 256, 256)],
        pool: POOL_VGG,
    },
    StageLayout {
        convolutions: &[same(17, 256, 512), same(19, 512, 512), same(21, 512, 512)],
        pool: POOL_VGG,
    },
    StageLayout { convolutions: &[same(24, 512, 512), same(26, 512, 512), same(28, 512, 512)], pool: NONE },
];

/// The stages of a network, the first first.
pub(super) fn stages(network: LpipsNetwork) -> &'static [StageLayout; LAYERS] {
    match network {
        LpipsNetwork::Alex => &ALEX,
        LpipsNetwork::Vgg => &VGG,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_count_and_find_what_they_look_at() {
        let window = Window { size: 11, stride: 4, padding: 2 };
        assert_eq!([6, 7, 10, 11, 224].map(|inputs| window.outputs(inputs)), [0, 1, 1, 2, 55]);
        assert_eq!(window.sources(&(0..1), 224), 0..9);
        assert_eq!(window.sources(&(2..4), 224), 6..21);
        assert_eq!(window.sources(&(54..55), 224), 214..224);
        assert_eq!(NONE.sources(&(3..9), 9), 3..9);
        assert_eq!(POOL_ALEX.sources(&(4..8), 100), 8..17);
    }
}
