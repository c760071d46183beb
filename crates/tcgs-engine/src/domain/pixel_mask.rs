//! Which pixels of a photograph count: those that are ignored are neither learnt nor measured.
//!
//! A bit a pixel, so that the masks of a dataset stay in memory beside photographs that do not.

use std::{fmt, sync::Arc};

/// Which pixels of a photograph count, row by row. Cheap to clone.
#[derive(Clone, PartialEq, Eq)]
pub struct PixelMask {
    width: u32,
    height: u32,
    words: Arc<[u64]>,
    counted: u64,
}

impl PixelMask {
    /// A mask of the pixels for which `counts` is true; `counts` gets column and row.
    #[must_use]
    pub fn from_fn(width: u32, height: u32, mut counts: impl FnMut(u32, u32) -> bool) -> Self {
        let pixels = width as usize * height as usize;
        let mut words = vec![0_u64; pixels.div_ceil(64)];
        let mut counted = 0;
        for y in 0..height {
            let row = y as usize * width as usize;
            for x in 0..width {
                if counts(x, y) {
                    let pixel = row + x as usize;
                    words[pixel / 64] |= 1 << (pixel % 64);
                    counted += 1;
                }
            }
        }
        Self { width, height, words: words.into(), counted }
    }

    /// A mask from 8-bit samples, a byte a pixel, of which only 255 counts; `None` if their number is not that of the pixels.
    #[must_use]
    pub fn from_samples(width: u32, height: u32, samples: &[u8]) -> Option<Self> {
        let is_whole = samples.len() == width as usize * height as usize;
        let counts = |x: u32, y: u32| samples[y as usize * width as usize + x as usize] == u8::MAX;
        is_whole.then(|| Self::from_fn(width, height, counts))
    }

    /// Width in pixels.
    #[must_use]
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    #[must_use]
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All pixels.
    #[must_use]
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// How many pixels count.
    #[must_use]
    pub fn counted(&self) -> u64 {
        self.counted
    }

    /// Whether a pixel counts, by its place row by row; none does beyond the last.
    #[must_use]
    pub fn counts(&self, pixel: usize) -> bool {
        (pixel as u64) < self.pixels() && self.words[pixel / 64] >> (pixel % 64) & 1 == 1
    }

    /// Whether each pixel counts, row by row.
    pub fn iter(&self) -> impl Iterator<Item = bool> + '_ {
        (0..self.pixels() as usize).map(|pixel| self.words[pixel / 64] >> (pixel % 64) & 1 == 1)
    }

    /// The pixels that count in both; `None` if the sizes differ.
    #[must_use]
    pub fn and(&self, other: &Self) -> Option<Self> {
        let same = (self.width, self.height) == (other.width, other.height);
        let words: Arc<[u64]> = self.words.iter().zip(&*other.words).map(|(a, b)| a & b).collect();
        let counted = words.iter().map(|word| u64::from(word.count_ones())).sum();
        same.then_some(Self { words, counted, ..*self })
    }

    /// Bytes that it holds in memory.
    #[must_use]
    pub fn bytes_in_memory(&self) -> u64 {
        Self::bytes(self.width, self.height)
    }

    /// Bytes of a mask of this size.
    #[must_use]
    pub fn bytes(width: u32, height: u32) -> u64 {
        (u64::from(width) * u64::from(height)).div_ceil(64) * 8
    }
}

impl fmt::Debug for PixelMask {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PixelMask({}x{}, {} count)", self.width, self.height, self.counted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_knows_its_pixels_and_their_number() {
        let mask = PixelMask::from_fn(13, 7, |x, y| (x + y) % 3 == 0);
        let expected: Vec<bool> = (0..91).map(|i| (i % 13 + i / 13) % 3 == 0).collect();
        assert_eq!(mask.iter().collect::<Vec<_>>(), expected);
        assert!((0..91).all(|i| mask.counts(i) == expected[i]) && !mask.counts(91));
        assert_eq!(mask.counted(), expected.iter().filter(|counts| **counts).count() as u64);
        assert_eq!((mask.width(), mask.height(), mask.pixels(), mask.bytes_in_memory()), (13, 7, 91, 16));
    }

    #[test]
    fn only_the_highest_sample_counts() {
        let mask = PixelMask::from_samples(2, 2, &[0, 255, 254, 1]).expect("four samples");
        assert_eq!(mask.iter().collect::<Vec<_>>(), [false, true, false, false]);
        assert_eq!(PixelMask::from_samples(2, 2, &[0; 3]), None);
    }

    #[test]
    fn what_counts_in_both_counts() {
        let (left, top) = (PixelMask::from_fn(4, 4, |x, _| x < 2), PixelMask::from_fn(4, 4, |_, y| y < 2));
        let both = left.and(&top).expect("one size");
        assert_eq!(both, PixelMask::from_fn(4, 4, |x, y| x < 2 && y < 2));
        assert_eq!(both.counted(), 4);
        assert_eq!(left.and(&PixelMask::from_fn(4, 3, |_, _| true)), None);
    }
}
