//! Resampling of 8-bit images: bilinear lookup and downscaling. Colors are weighted by alpha, so invisible pixels do not bleed into
//! visible ones.

use image::{ImageBuffer, Rgb, Rgba, imageops};

use crate::domain::Image;

/// Appends the color at pixel coordinates (x, y), centers at +0.5, rim pixels repeated outwards.
pub(super) fn bilinear(image: &Image, x: f64, y: f64, samples: &mut Vec<u8>) {
    let (left, right, along_x) = neighbors(x, image.width());
    let (top, bottom, along_y) = neighbors(y, image.height());
    let channels = usize::from(image.channels());
    let pixel = |column: usize, row: usize| {
        let at = (row * image.width() as usize + column) * channels;
        &image.samples()[at..at + channels]
    };
    let taps = [
        (pixel(left, top), (1.0 - along_x) * (1.0 - along_y)),
        (pixel(right, top), along_x * (1.0 - along_y)),
        (pixel(left, bottom), (1.0 - along_x) * along_y),
        (pixel(right, bottom), along_x * along_y),
    ];
    if channels == 3 {
        for channel in 0..3 {
            let value: f32 = taps.iter().map(|(pixel, weight)| f32::from(pixel[channel]) * weight).sum();
            samples.push(to_u8(value));
        }
        return;
    }
    let alpha: f32 = taps.iter().map(|(pixel, weight)| f32::from(pixel[3]) * weight).sum();
    for channel in 0..3 {
        let weighted: f32 =
            taps.iter().map(|(pixel, weight)| f32::from(pixel[channel]) * f32::from(pixel[3]) * weight).sum();
        samples.push(if alpha > 0.0 { to_u8(weighted / alpha) } else { 0 });
    }
    samples.push(to_u8(alpha));
}

/// The image at a smaller size, by an antialiased bicubic filter (a = -0.5), as the field's loaders use.
pub(super) fn downscaled(image: Image, width: u32, height: u32) -> Image {
    const FILTER: imageops::FilterType = imageops::FilterType::CatmullRom;
    let (from_width, from_height, channels) = (image.width(), image.height(), image.channels());
    let filled = "the samples of an image fill its shape";
    let samples = if channels == 3 {
        let rgb: ImageBuffer<Rgb<u8>, _> =
            ImageBuffer::from_raw(from_width, from_height, image.samples()).expect(filled);
        imageops::resize(&rgb, width, height, FILTER).into_raw()
    } else {
        let weighted: Vec<f32> = image
            .samples()
            .chunks_exact(4)
            .flat_map(|pixel| {
                let alpha = f32::from(pixel[3]) / 255.0;
                let [r, g, b] = [pixel[0], pixel[1], pixel[2]].map(|value| f32::from(value) / 255.0 * alpha);
                [r, g, b, alpha]
            })
            .collect();
        let rgba: ImageBuffer<Rgba<f32>, _> =
            ImageBuffer::from_raw(from_width, from_height, weighted).expect(filled);
        imageops::resize(&rgba, width, height, FILTER)
            .into_raw()
            .chunks_exact(4)
            .flat_map(|pixel| {
                let color = |value: f32| if pixel[3] > 0.0 { to_u8(value / pixel[3] * 255.0) } else { 0 };
                [color(pixel[0]), color(pixel[1]), color(pixel[2]), to_u8(pixel[3] * 255.0)]
            })
            .collect()
    };
    Image::new(width, height, channels, samples).expect("a resized image fills its new shape")
}

/// The two pixels around a coordinate and how far it is from the first to the second.
fn neighbors(at: f64, side: u32) -> (usize, usize, f32) {
    let last = f64::from(side - 1);
    let at = (at - 0.5).clamp(0.0, last);
    let first = at.floor();
    (first as usize, (first + 1.0).min(last) as usize, (at - first) as f32)
}

fn to_u8(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(image: &Image, x: f64, y: f64) -> Vec<u8> {
        let mut samples = Vec::new();
        bilinear(image, x, y, &mut samples);
        samples
    }

    #[test]
    fn centers_are_exact_and_between_them_is_linear() {
        let image = Image::new(2, 2, 3, vec![0, 0, 0, 100, 0, 0, 0, 200, 0, 100, 200, 40]).expect("an image");
        assert_eq!(at(&image, 1.5, 0.5), [100, 0, 0]);
        assert_eq!(at(&image, 1.0, 0.5), [50, 0, 0]);
        assert_eq!(at(&image, 1.0, 1.0), [50, 100, 10]);
        assert_eq!(at(&image, 0.0, 2.0), [0, 200, 0], "the rim is repeated");
        assert_eq!(at(&image, 2.0, 2.0), [100, 200, 40]);
    }

    #[test]
    fn invisible_pixels_lend_no_color() {
        let image = Image::new(2, 1, 4, vec![255, 0, 0, 0, 10, 20, 30, 255]).expect("an image");
        assert_eq!(at(&image, 1.0, 0.5), [10, 20, 30, 128]);
        assert_eq!(at(&image, 0.5, 0.5), [0, 0, 0, 0]);
        let row = [255, 255, 255, 0, 10, 20, 30, 255].repeat(8);
        let small = downscaled(Image::new(16, 1, 4, row).expect("an image"), 4, 1);
        for pixel in small.samples().chunks_exact(4) {
            assert_eq!(pixel[..3], [10, 20, 30], "{pixel:?}");
        }
    }

    #[test]
    fn downscaling_keeps_flat_colors_and_the_mean_of_a_ramp() {
        let flat = downscaled(Image::new(9, 6, 3, [7, 99, 250].repeat(54)).expect("an image"), 3, 2);
        assert_eq!(flat.samples(), [7, 99, 250].repeat(6));
        let ramp: Vec<u8> = (0..64_u8).flat_map(|value| [value; 3]).collect();
        let small = downscaled(Image::new(64, 1, 3, ramp).expect("an image"), 4, 1);
        for (index, pixel) in small.samples().chunks_exact(3).enumerate() {
            let expected = 16.0 * index as f64 + 7.5;
            assert!((f64::from(pixel[0]) - expected).abs() <= 2.0, "{index}: {}", pixel[0]);
        }
    }
}
