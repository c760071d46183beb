//! Animated PNG, frame by frame.

use std::{
    io::{self, Write},
    mem,
    sync::{Arc, Mutex, PoisonError},
};

use bytes::Bytes;
use png::{BitDepth, ColorType, Encoder, EncodingError, Writer};

use super::{picture::Rendered, view_renderer::failed};
use crate::domain::Problem;

/// Bytes written and not yet taken.
#[derive(Debug, Clone, Default)]
struct Written(Arc<Mutex<Vec<u8>>>);

impl Written {
    fn take(&self) -> Bytes {
        mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner)).into()
    }
}

impl Write for Written {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// An unfinished file that loops for ever.
pub(super) struct Apng {
    writer: Writer<Written>,
    written: Written,
}

impl Apng {
    /// A file of exactly `frames` RGB frames.
    pub(super) fn new(width: u32, height: u32, frames: u32, per_second: u16) -> Result<Self, EncodingError> {
        let written = Written::default();
        let mut encoder = Encoder::new(written.clone(), width, height);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_animated(frames, 0)?;
        encoder.set_frame_delay(1, per_second)?;
        Ok(Self { writer: encoder.write_header()?, written })
    }

    /// Adds a frame, and finishes the file after the last. Returns the file unless it is finished, and its bytes since the last call.
    pub(super) fn add(mut self, frame: &Rendered, is_last: bool) -> Result<(Option<Self>, Bytes), Problem> {
        let Rendered::Color(image) = frame else {
            return Err(failed(&io::Error::other("only colour is animated")));
        };
        let flat;
        let image = if image.channels() == 3 {
            image
        } else {
            flat = image.over([0; 3]);
            &flat
        };
        self.writer.write_image_data(image.samples()).map_err(|error| failed(&error))?;
        if !is_last {
            let bytes = self.written.take();
            return Ok((Some(self), bytes));
        }
        self.writer.finish().map_err(|error| failed(&error))?;
        Ok((None, self.written.take()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Image;

    #[test]
    fn frames_come_in_pieces_that_make_a_file() {
        let frame = |level: u8| Image::new(4, 3, 3, vec![level; 36]).expect("an image");
        let mut apng = Apng::new(4, 3, 3, 10).ok();
        let mut file = Vec::new();
        for level in [10, 20, 30] {
            let now = apng.take().expect("goes on");
            let (next, bytes) = now.add(&Rendered::Color(frame(level)), level == 30).expect("a frame");
            assert!(!bytes.is_empty(), "each frame is there at once");
            file.extend_from_slice(&bytes);
            apng = next;
        }
        assert!(apng.is_none());
        let mut reader = png::Decoder::new(io::Cursor::new(&file)).read_info().expect("a PNG");
        let control = *reader.info().animation_control().expect("animated");
        assert_eq!((control.num_frames, control.num_plays), (3, 0));
        let mut samples = vec![0; 36];
        for level in [10, 20, 30] {
            reader.next_frame(&mut samples).expect("a frame");
            assert_eq!(samples, [level; 36]);
            let delay = reader.info().frame_control().expect("a frame's head");
            assert_eq!((delay.delay_num, delay.delay_den), (1, 10));
        }
    }
}
