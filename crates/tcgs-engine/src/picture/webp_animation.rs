//! Animated WebP from single WebPs, lossless or lossy (WebP container specification, "Animation").
//!
//! Frames are compressed before, so several at once. The container begins with its length, so its head follows from all frames, whose
//! parts follow from their number and file alone.

use super::PictureError;

/// Sets the bit that says that there are frames.
const ANIMATION: u8 = 1 << 1;
/// Sets the bit that says that frames may be transparent. The head is written without them, and opaque ones stay so.
const ALPHA: u8 = 1 << 4;
/// Frames replace each other: no blending, no disposal.
const REPLACE: u8 = 1 << 1;

/// An animation that loops for ever.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WebpAnimation {
    /// Frames a second, at least 1.
    pub rate: u16,
    /// Width and height in pixels.
    pub size: [u32; 2],
}

impl WebpAnimation {
    /// The start of the file, before parts of `frames` bytes in sum.
    ///
    /// # Errors
    /// [`PictureError::TooLong`] for more than a container may have.
    pub fn head(&self, frames: usize) -> Result<Vec<u8>, PictureError> {
        let mut chunks = Vec::new();
        let [width, height] = self.size.map(one_less);
        write(&mut chunks, b"VP8X", &[&[ANIMATION | ALPHA, 0, 0, 0], &width, &height]);
        // A transparent background and no number of rounds.
        write(&mut chunks, b"ANIM", &[&[0; 4], &[0; 2]]);
        let length = u32::try_from(4 + chunks.len() + frames).ok().filter(|length| *length < u32::MAX - 10);
        let length = length.ok_or(PictureError::TooLong)?.to_le_bytes();
        Ok([b"RIFF", &length, b"WEBP", &chunks[..]].concat())
    }

    /// The part of the file with frame `index`, from the frame's own WebP.
    ///
    /// # Errors
    /// [`PictureError::Frame`] for a file that is no whole WebP, or of another size.
    pub fn part(&self, index: u32, webp: &[u8]) -> Result<Vec<u8>, PictureError> {
        let no_frame = || PictureError::Frame(index);
        let bits = bit_streams(webp).filter(|bits| bits.size() == Some(self.size)).ok_or_else(no_frame)?;
        let mut picture = Vec::with_capacity(webp.len());
        if let Some(alpha) = bits.alpha {
            write(&mut picture, b"ALPH", &[alpha]);
        }
        write(&mut picture, bits.kind, &[bits.picture]);
        let [width, height] = self.size.map(one_less);
        let mut part = Vec::with_capacity(picture.len() + 24);
        write(
            &mut part,
            b"ANMF",
            &[&[0; 6], &width, &height, &self.milliseconds(index), &[REPLACE], &picture],
        );
        Ok(part)
    }

    /// How long a frame is shown. The times of all frames add up, though not each is a whole number of milliseconds.
    fn milliseconds(&self, index: u32) -> [u8; 3] {
        let rate = u64::from(self.rate.max(1));
        let begin = |index: u64| (1000 * index + rate / 2) / rate;
        let index = u64::from(index);
        let shown = begin(index + 1) - begin(index);
        let [a, b, c, ..] = shown.to_le_bytes();
        [a, b, c]
    }
}

/// A side as the container has it: 24 bits of one less.
fn one_less(side: u32) -> [u8; 3] {
    let [a, b, c, _] = side.saturating_sub(1).to_le_bytes();
    [a, b, c]
}

/// The bit streams of a file with one picture.
struct BitStreams<'a> {
    /// Opacity of a lossy picture, if it has any.
    alpha: Option<&'a [u8]>,
    /// `VP8L` of a lossless picture, `VP8 ` of a lossy one.
    kind: &'static [u8; 4],
    picture: &'a [u8],
}

fn bit_streams(webp: &[u8]) -> Option<BitStreams<'_>> {
    let mut rest = webp.strip_prefix(b"RIFF")?.get(4..)?.strip_prefix(b"WEBP")?;
    let mut alpha = None;
    loop {
        let (kind, after) = rest.split_first_chunk::<4>()?;
        let (length, after) = after.split_first_chunk::<4>()?;
        let length = u32::from_le_bytes(*length) as usize;
        let (data, after) = after.split_at_checked(length)?;
        match kind {
            b"ALPH" => alpha = Some(data),
            b"VP8L" => return Some(BitStreams { alpha: None, kind: b"VP8L", picture: data }),
            b"VP8 " => return Some(BitStreams { alpha, kind: b"VP8 ", picture: data }),
            _ => {}
        }
        rest = after.get(length % 2..)?;
    }
}

impl BitStreams<'_> {
    /// Width and height in the head of the picture's bit stream.
    fn size(&self) -> Option<[u32; 2]> {
        if self.kind == b"VP8L" {
            let bits = u32::from_le_bytes(*self.picture.strip_prefix(&[0x2f])?.first_chunk::<4>()?);
            return Some([(bits & 0x3fff) + 1, ((bits >> 14) & 0x3fff) + 1]);
        }
        // After the frame's tag and start code, each side has 14 bits and two for its scale.
        let [a, b, c, d] = *self.picture.get(3..)?.strip_prefix(&[0x9d, 0x01, 0x2a])?.first_chunk::<4>()?;
        Some([[a, b], [c, d]].map(|side| u32::from(u16::from_le_bytes(side) & 0x3fff)))
    }
}

fn write(file: &mut Vec<u8>, kind: &[u8; 4], data: &[&[u8]]) {
    let length: usize = data.iter().map(|data| data.len()).sum();
    file.extend(kind);
    file.extend((length as u32).to_le_bytes());
    data.iter().for_each(|data| file.extend_from_slice(data));
    if length % 2 == 1 {
        file.push(0);
    }
}

#[cfg(test)]
mod tests {
    use image::{AnimationDecoder as _, codecs::webp::WebPDecoder};

    use super::*;
    use crate::{domain::Image, picture::PictureFormat};

    fn frame(level: u8, channels: u8) -> Vec<u8> {
        let samples = vec![level; 15 * usize::from(channels)];
        let image = Image::new(5, 3, channels, samples).expect("an image");
        PictureFormat::Webp.encode(&image).expect("encodes")
    }

    #[test]
    fn parts_make_a_file_that_plays_every_frame() {
        let levels = [10, 20, 30];
        for channels in [3, 4] {
            let animation = WebpAnimation { rate: 12, size: [5, 3] };
            let parts =
                levels.iter().zip(0..).map(|(level, index)| animation.part(index, &frame(*level, channels)));
            let parts = parts.collect::<Result<Vec<_>, _>>().expect("parts").concat();
            let file = [animation.head(parts.len()).expect("a head"), parts].concat();
            assert_eq!(u32::from_le_bytes(file[4..8].try_into().expect("four")) as usize, file.len() - 8);
            let decoder = WebPDecoder::new(std::io::Cursor::new(&file)).expect("a WebP");
            assert!(decoder.has_animation());
            let frames = decoder.into_frames().collect_frames().expect("frames");
            assert_eq!(frames.len(), 3);
            for (frame, level) in frames.iter().zip(levels) {
                let pixel = frame.buffer().get_pixel(4, 2).0;
                assert_eq!(pixel, if channels == 3 { [level, level, level, 255] } else { [level; 4] });
            }
            let shown: u32 = frames.iter().map(|frame| frame.delay().numer_denom_ms().0).sum();
            assert_eq!(shown, 250, "three twelfths of a second");
        }
    }

    #[test]
    fn lossy_frames_play_too_opaque_or_not() {
        for channels in [3, 4] {
            let animation = WebpAnimation { rate: 10, size: [5, 3] };
            let lossy = |level: u8| {
                let samples = vec![level; 15 * usize::from(channels)];
                let image = Image::new(5, 3, channels, samples).expect("an image");
                PictureFormat::LossyWebp { quality: 80 }.encode(&image).expect("encodes")
            };
            let parts = [lossy(60), lossy(200)];
            let parts = parts.iter().zip(0..).map(|(file, index)| animation.part(index, file));
            let parts = parts.collect::<Result<Vec<_>, _>>().expect("parts").concat();
            let file = [animation.head(parts.len()).expect("a head"), parts].concat();
            let decoder = WebPDecoder::new(std::io::Cursor::new(&file)).expect("a WebP");
            let frames = decoder.into_frames().collect_frames().expect("frames");
            assert_eq!(frames.len(), 2);
            for (frame, level) in frames.iter().zip([60, 200]) {
                let [red, .., alpha] = frame.buffer().get_pixel(2, 1).0;
                assert!(red.abs_diff(level) < 6, "{red} for {level}");
                assert_eq!(alpha, if channels == 3 { 255 } else { level });
            }
        }
    }

    #[test]
    fn frames_of_another_size_and_files_that_are_no_webp_are_refused() {
        let animation = WebpAnimation { rate: 10, size: [5, 4] };
        assert!(matches!(animation.part(1, &frame(1, 3)), Err(PictureError::Frame(1))));
        let animation = WebpAnimation { size: [5, 3], ..animation };
        let whole = frame(1, 3);
        for end in 0..whole.len() - 1 {
            assert!(animation.part(0, &whole[..end]).is_err(), "{end} bytes");
        }
        assert!(animation.part(0, b"\x89PNG").is_err());
        assert!(matches!(animation.head(u32::MAX as usize), Err(PictureError::TooLong)));
    }
}
