//! Animated PNG from single PNGs, frame by frame (PNG specification, third edition, 11.3.6).
//!
//! Frames are compressed before, so several at once. Each frame's bytes follow from its number and its file alone.

use super::PictureError;

const SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

/// An animation that loops for ever.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Apng {
    /// Number of frames.
    pub frames: u32,
    /// Frames a second.
    pub rate: u16,
    /// Width and height in pixels.
    pub size: [u32; 2],
}

impl Apng {
    /// The part of the file with frame `index`, from the frame's own PNG: the first part has the file's head, the last its end.
    ///
    /// # Errors
    /// [`PictureError::Frame`] for a PNG of another size or without pixels.
    pub fn part(&self, index: u32, png: &[u8]) -> Result<Vec<u8>, PictureError> {
        let mut part = Vec::with_capacity(png.len() + 128);
        let mut head = None;
        let mut pixels = Vec::with_capacity(png.len());
        let mut rest = png.strip_prefix(SIGNATURE).ok_or(PictureError::Frame(index))?;
        while let Some((kind, data, after)) = chunk(rest) {
            match kind {
                b"IHDR" => head = Some(data),
                b"IDAT" => pixels.extend_from_slice(data),
                _ => {}
            }
            rest = after;
        }
        let [width, height] = self.size.map(u32::to_be_bytes);
        let head = head.filter(|head| head.starts_with(&[width, height].concat()) && !pixels.is_empty());
        let head = head.ok_or(PictureError::Frame(index))?;
        if index == 0 {
            part.extend_from_slice(SIGNATURE);
            write(&mut part, b"IHDR", &[head]);
            // No number of rounds.
            write(&mut part, b"acTL", &[&self.frames.to_be_bytes(), &[0; 4]]);
        }
        // Control and pixels of all frames are numbered together; the first frame's pixels have no number.
        let number = (2 * index).saturating_sub(1);
        let delay = [1_u16.to_be_bytes(), self.rate.to_be_bytes()].concat();
        let (place, blending) = ([0; 8], [0; 2]);
        write(&mut part, b"fcTL", &[&number.to_be_bytes(), &width, &height, &place, &delay, &blending]);
        if index == 0 {
            write(&mut part, b"IDAT", &[&pixels]);
        } else {
            write(&mut part, b"fdAT", &[&(number + 1).to_be_bytes(), &pixels]);
        }
        if index + 1 == self.frames {
            write(&mut part, b"IEND", &[]);
        }
        Ok(part)
    }
}

/// Kind and data of the first chunk, and what follows it.
fn chunk(file: &[u8]) -> Option<(&[u8; 4], &[u8], &[u8])> {
    let (length, rest) = file.split_first_chunk::<4>()?;
    let (kind, rest) = rest.split_first_chunk::<4>()?;
    let (data, rest) = rest.split_at_checked(u32::from_be_bytes(*length) as usize)?;
    Some((kind, data, rest.get(4..)?))
}

fn write(file: &mut Vec<u8>, kind: &[u8; 4], data: &[&[u8]]) {
    let length: usize = data.iter().map(|data| data.len()).sum();
    file.extend((length as u32).to_be_bytes());
    let begin = file.len();
    file.extend(kind);
    data.iter().for_each(|data| file.extend_from_slice(data));
    let sum = crc32fast::hash(&file[begin..]);
    file.extend(sum.to_be_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{domain::Image, picture::PictureFormat};

    fn frame(level: u8, channels: u8) -> Vec<u8> {
        let samples = vec![level; 12 * usize::from(channels)];
        let image = Image::new(4, 3, channels, samples).expect("an image");
        PictureFormat::Png.encode(&image).expect("encodes")
    }

    #[test]
    fn parts_make_a_file_that_plays_every_frame() {
        let apng = Apng { frames: 3, rate: 10, size: [4, 3] };
        let levels = [10, 20, 30];
        let parts = levels.iter().zip(0..).map(|(level, index)| apng.part(index, &frame(*level, 3)));
        let file = parts.collect::<Result<Vec<_>, _>>().expect("parts").concat();
        let mut reader = ::png::Decoder::new(std::io::Cursor::new(&file)).read_info().expect("a PNG");
        let control = *reader.info().animation_control().expect("animated");
        assert_eq!((control.num_frames, control.num_plays), (3, 0));
        let mut samples = vec![0; 36];
        for level in levels {
            reader.next_frame(&mut samples).expect("a frame");
            assert_eq!(samples, [level; 36]);
            let delay = reader.info().frame_control().expect("a frame's head");
            assert_eq!((delay.delay_num, delay.delay_den), (1, 10));
        }
        assert!(reader.next_frame(&mut samples).is_err(), "three frames");
    }

    #[test]
    fn frames_of_another_size_and_files_that_are_no_png_are_refused() {
        let apng = Apng { frames: 2, rate: 10, size: [4, 4] };
        assert!(matches!(apng.part(1, &frame(1, 3)), Err(PictureError::Frame(1))));
        let apng = Apng { size: [4, 3], ..apng };
        let whole = frame(1, 3);
        for end in 0..whole.len() - 12 {
            // Without the file's end, all of the pixels are there.
            assert!(apng.part(0, &whole[..end]).is_err(), "{end} bytes");
        }
        assert!(apng.part(0, b"\xff\xd8\xff").is_err());
    }
}
