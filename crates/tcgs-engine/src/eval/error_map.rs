//! Where a render differs from its photograph, as a picture.
//!
//! Errors are taken at full size and averaged only then, so that a small picture shows as much error as the large one.

use colorous::INFERNO;
use image::{ImageBuffer, Luma, RgbImage, imageops};

use super::quality::comparable;
use crate::domain::Image;

/// The error, as a fraction of full range, that has the ramp's last color; the same for every picture, so that they compare.
pub const ERROR_CEILING: f64 = 0.2;

/// Number of colors in [`error_ramp`].
const RAMP_COLORS: usize = 17;

/// The colors of errors from none to [`ERROR_CEILING`]: even steps look even, and lightness alone tells them apart.
#[must_use]
pub fn error_ramp() -> Vec<[u8; 3]> {
    (0..RAMP_COLORS).map(|place| color(place as f64 / (RAMP_COLORS - 1) as f64)).collect()
}

/// The error of each pixel by color, root mean square over the channels, at most `side` pixels per side; `None` if the
/// images are not of one shape.
#[must_use]
pub fn error_map(render: &Image, photograph: &Image, side: u32) -> Option<Image> {
    comparable(render, photograph)?;
    let error = |(a, b): (&[u8], &[u8])| {
        let squares = a.iter().zip(b).map(|(x, y)| (f32::from(*x) - f32::from(*y)).powi(2));
        (squares.sum::<f32>() / 3.0).sqrt() / 255.0
    };
    let pixels = render.samples().chunks_exact(3).zip(photograph.samples().chunks_exact(3));
    let plane: Vec<f32> = pixels.map(error).collect();
    let (width, height) = shrunk_size(render, side);
    let mut plane = ImageBuffer::<Luma<f32>, _>::from_raw(render.width(), render.height(), plane)?;
    if (width, height) != plane.dimensions() {
        plane = imageops::resize(&plane, width, height, imageops::FilterType::Triangle);
    }
    let samples = plane.iter().flat_map(|error| color(f64::from(*error) / ERROR_CEILING)).collect();
    Image::new(width, height, 3, samples).ok()
}

/// An RGB image at most `side` pixels per side; `None` if there is alpha.
#[must_use]
pub fn shrunk(image: &Image, side: u32) -> Option<Image> {
    comparable(image, image)?;
    let (width, height) = shrunk_size(image, side);
    if (width, height) == (image.width(), image.height()) {
        return Some(image.clone());
    }
    let pixels = RgbImage::from_raw(image.width(), image.height(), image.samples().to_vec())?;
    let small = imageops::resize(&pixels, width, height, imageops::FilterType::Triangle);
    Image::new(width, height, 3, small.into_raw()).ok()
}

fn shrunk_size(image: &Image, side: u32) -> (u32, u32) {
    let (width, height) = (image.width(), image.height());
    let longest = width.max(height);
    if longest <= side {
        return (width, height);
    }
    let scaled = |length: u32| {
        let length = f64::from(length) * f64::from(side) / f64::from(longest);
        (length.round() as u32).max(1)
    };
    (scaled(width), scaled(height))
}

fn color(share: f64) -> [u8; 3] {
    let color = INFERNO.eval_continuous(share.clamp(0.0, 1.0));
    [color.r, color.g, color.b]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(width: u32, height: u32, value: u8) -> Image {
        Image::new(width, height, 3, vec![value; (width * height * 3) as usize]).expect("an image")
    }

    #[test]
    fn an_error_has_the_color_of_its_place_on_the_ramp() {
        let ramp = error_ramp();
        let at = |error: u8| error_map(&flat(3, 2, 100 + error), &flat(3, 2, 100), 64).expect("comparable");
        assert_eq!(at(0).samples()[..3], ramp[0]);
        for beyond in [51, 52, 155] {
            assert_eq!(at(beyond).samples()[..3], ramp[RAMP_COLORS - 1], "{beyond}");
        }
        let lightness = |color: &[u8]| color.iter().map(|v| u32::from(*v)).sum::<u32>();
        assert!(ramp.windows(2).all(|pair| lightness(&pair[0]) < lightness(&pair[1])));
        assert!(lightness(&at(20).samples()[..3]) < lightness(&at(30).samples()[..3]));
    }

    #[test]
    fn small_pictures_keep_their_shape_and_their_mean() {
        let checks: Vec<u8> =
            (0..64 * 32).flat_map(|i| [if (i + i / 64) % 2 == 0 { 80 } else { 120 }; 3]).collect();
        let fine = Image::new(64, 32, 3, checks).expect("an image");
        let small = shrunk(&fine, 16).expect("RGB");
        assert_eq!((small.width(), small.height()), (16, 8));
        assert!(small.samples().iter().all(|value| value.abs_diff(100) <= 2), "{:?}", small.samples());
        assert_eq!(shrunk(&fine, 64), Some(fine.clone()));
        // The two differ everywhere by 20, and do so in the small picture, although the small images are nearly equal.
        let map = error_map(&fine, &flat(64, 32, 100), 16).expect("comparable");
        let even = error_map(&flat(1, 1, 120), &flat(1, 1, 100), 16).expect("comparable");
        assert!(
            map.samples()
                .chunks_exact(3)
                .all(|pixel| pixel.iter().zip(even.samples()).all(|(a, b)| a.abs_diff(*b) <= 2))
        );
    }

    #[test]
    fn what_cannot_be_compared_has_no_map() {
        assert_eq!(error_map(&flat(2, 2, 0), &flat(2, 3, 0), 8), None);
        let alpha = Image::new(1, 1, 4, vec![0; 4]).expect("an image");
        assert_eq!(shrunk(&alpha, 8), None);
    }
}
