//! A training photograph as its loss compared it with renders: through the color correction that the run learnt, and only where pixels
//! count.

use super::ColorFit;
use crate::domain::Frame;

/// A training photograph, with the color correction that the run learnt for it (METHOD.md §2.11).
#[derive(Debug, Clone, Copy)]
pub struct TrainView<'a> {
    /// The photograph.
    pub frame: &'a Frame,
    /// Corrects the colors of renders before they are compared with the photograph; `None` in a run without corrections.
    pub correction: Option<ColorFit>,
}

/// A photograph without a correction.
impl<'a> From<&'a Frame> for TrainView<'a> {
    fn from(frame: &'a Frame) -> Self {
        Self { frame, correction: None }
    }
}

impl TrainView<'_> {
    /// The color that the loss compares with the photograph, of a color of the render; both in [0, 1], neither clamped.
    #[must_use]
    pub fn compared(&self, [r, g, b, _]: [f32; 4]) -> [f32; 3] {
        self.correction.map_or([r, g, b], |fit| fit.corrected([r, g, b]))
    }

    /// Turns the gradient of a loss by the compared colors, a row a pixel, into the one by the colors of the render: zero where pixels do
    /// not count.
    pub fn gradient_by_render(&self, d_image: &mut [[f32; 4]]) {
        if let Some(fit) = self.correction {
            d_image.iter_mut().for_each(|[r, g, b, _]| [*r, *g, *b] = fit.transposed([*r, *g, *b]));
        }
        if let Some(mask) = &self.frame.mask {
            d_image
                .iter_mut()
                .zip(mask.iter())
                .filter(|(_, counts)| !counts)
                .for_each(|(d, _)| *d = [0.0; 4]);
        }
    }

    /// Pixels that count.
    #[must_use]
    pub fn counted(&self) -> u64 {
        let size = &self.frame.camera.intrinsics;
        let pixels = u64::from(size.width) * u64::from(size.height);
        self.frame.mask.as_ref().map_or(pixels, |mask| mask.counted())
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::domain::{Camera, Image, Intrinsics, PixelMask, Pose, Split};

    const ROWS: [[f32; 4]; 3] = [[0.5, 0.25, -0.5, 0.125], [0.0, 1.5, 0.25, -0.25], [0.0, 0.0, 0.0, 0.5]];

    fn frame(mask: Option<PixelMask>) -> Frame {
        let k = Intrinsics::from_horizontal_fov(1.0, 3, 2).expect("intrinsics");
        let pose = Pose::look_at(DVec3::NEG_Z, DVec3::ZERO, DVec3::Y).expect("a pose");
        Frame {
            name: "a".to_owned(),
            camera: Camera::new(k, pose).expect("a camera"),
            image: Image::new(3, 2, 3, vec![7; 18]).expect("an image").into(),
            mask,
            split: Split::Train,
        }
    }

    #[test]
    fn gradients_are_those_of_compared_colors_where_pixels_count() {
        let frame = frame(Some(PixelMask::from_fn(3, 2, |x, _| x > 0)));
        let view = TrainView { frame: &frame, correction: Some(ROWS.into()) };
        assert_eq!(view.counted(), 4);
        let (color, weights) = ([0.25, 0.5, 1.0, 0.0], [1.0, -2.0, 4.0]);
        let loss = |color| -> f32 { view.compared(color).iter().zip(weights).map(|(a, b)| a * b).sum() };
        let mut d_image = vec![[1.0, -2.0, 4.0, 0.0]; 6];
        view.gradient_by_render(&mut d_image);
        for channel in 0..3 {
            let mut moved = color;
            moved[channel] += 1.0;
            assert_eq!(d_image[1][channel], loss(moved) - loss(color), "channel {channel}");
        }
        assert_eq!([d_image[0], d_image[3]], [[0.0; 4]; 2]);
        assert!([1, 2, 4, 5].iter().all(|pixel| d_image[*pixel] == d_image[1]));
    }

    #[test]
    fn without_correction_and_mask_nothing_changes() {
        let frame = frame(None);
        let view = TrainView::from(&frame);
        assert_eq!((view.counted(), view.compared([0.1, 0.2, 0.3, 0.4])), (6, [0.1, 0.2, 0.3]));
        let mut d_image = vec![[1.0, -2.0, 4.0, 0.5]; 6];
        view.gradient_by_render(&mut d_image);
        assert_eq!(d_image, vec![[1.0, -2.0, 4.0, 0.5]; 6]);
    }
}
