//! What the masks of a dataset mean, and reading those of a photograph.

use image::metadata::Orientation;

use super::{
    error::{IngestError, IngestErrorKind},
    images::{self, DECODE_BYTES, Header, swaps_sides},
    limits::Limits,
    mask_pixels::{Hidden, Plane, fits},
    mask_search::FoundMasks,
    masks::is_dynamic,
    tree::Tree,
};
use crate::domain::{Layout, MaskMode};

/// How many of instant-ngp's masks are read to learn whether white is hidden in them.
const SAMPLED: usize = 8;

/// The masks of one photograph.
#[derive(Debug, Default)]
pub(super) struct FrameMasks {
    pub(super) files: Vec<MaskFile>,
    pub(super) mode: Mode,
}

/// What hides.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Mode {
    /// Masks become the photograph's transparency.
    pub(super) cuts_out: bool,
    /// What is transparent does not count.
    pub(super) ignores_alpha: bool,
}

/// A mask in the tree.
#[derive(Debug)]
pub(super) struct MaskFile {
    pub(super) file: String,
    pub(super) turn: Orientation,
    pub(super) hidden: Hidden,
    /// Bytes that decoding it takes.
    bytes: u64,
}

impl FrameMasks {
    /// Whether masks become transparency.
    pub(super) fn cuts_out(&self) -> bool {
        self.mode.cuts_out && !self.files.is_empty()
    }

    /// The most memory that reading them takes, of a photograph of so many pixels.
    pub(super) fn decode_bytes(&self, pixels: u64, alpha: bool) -> u64 {
        // Two planes, and three channels before and behind the lens.
        const PLANE_BYTES: u64 = 2 + 3 + 3;
        let planes = !self.files.is_empty() || (alpha && self.mode.ignores_alpha);
        let largest = self.files.iter().map(|mask| mask.bytes).max().unwrap_or(0);
        largest.saturating_add(if planes { PLANE_BYTES * pixels } else { 0 })
    }
}

/// What reading masks depends on besides the dataset.
pub(super) struct MaskOptions<'a> {
    pub(super) mode: MaskMode,
    /// The most memory for decoding a mask to learn what it hides.
    pub(super) decode_bytes: u64,
    /// Once it returns false, reading stops.
    pub(super) should_continue: &'a (dyn Fn() -> bool + Sync),
}

/// Reads masks by what they mean.
pub(super) struct MaskReader<'a> {
    tree: &'a Tree,
    limits: &'a Limits,
    mode: Mode,
    /// What instant-ngp's masks hide; `None` if there are none.
    dynamic: Option<Dynamic>,
}

/// What is known of instant-ngp's masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Dynamic {
    Hides(Hidden),
    /// They were not read, as in a check without pixels.
    NotRead,
}

impl<'a> MaskReader<'a> {
    /// # Errors
    /// [`IngestErrorKind::Stopped`], and the deadline.
    pub(super) fn new(
        tree: &'a Tree,
        masks: &FoundMasks,
        limits: &'a Limits,
        options: &MaskOptions,
    ) -> Result<Self, IngestError> {
        let mode = Mode {
            cuts_out: options.mode == MaskMode::CutOut,
            ignores_alpha: options.mode == MaskMode::Ignore,
        };
        let mut reader = Self { tree, limits, mode, dynamic: None };
        let dynamic: Vec<&String> =
            masks.of_frames.iter().flatten().filter(|file| is_dynamic(file)).collect();
        if !dynamic.is_empty() {
            reader.dynamic = Some(reader.sampled(&dynamic, options)?);
        }
        Ok(reader)
    }

    /// White is what moves in instant-ngp's masks, a small part of most pictures. Where it is half of the sampled masks or more, other
    /// programs have written them, in which white is what counts.
    fn sampled(&self, files: &[&String], options: &MaskOptions) -> Result<Dynamic, IngestError> {
        let (mut sum, mut read) = (0.0, 0);
        for file in files.iter().step_by(files.len().div_ceil(SAMPLED)) {
            if !(options.should_continue)() {
                return Err(IngestErrorKind::Stopped.into());
            }
            self.tree.check_time()?;
            let header = images::header(self.tree, file, self.limits)?;
            if self.decode_bytes(file, &header) <= options.decode_bytes
                && let Ok(bytes) = self.tree.read(file)
                && let Ok(plane) =
                    Plane::decode(&bytes, Orientation::NoTransforms, Hidden::Black, self.limits)
            {
                sum += plane.white();
                read += 1;
            }
        }
        Ok(match read {
            0 => Dynamic::NotRead,
            _ if sum / f64::from(read) < 0.5 => Dynamic::Hides(Hidden::White),
            _ => Dynamic::Hides(Hidden::Black),
        })
    }

    fn decode_bytes(&self, file: &str, header: &Header) -> u64 {
        let pixels = u64::from(header.size.0) * u64::from(header.size.1);
        self.tree.size(file).saturating_mul(2).saturating_add(DECODE_BYTES * pixels)
    }

    /// The masks of a photograph, whose header this is, and which has `size` once it is turned by `turn`.
    ///
    /// # Errors
    /// A header that cannot be read, or a size that does not fit.
    pub(super) fn of_frame(
        &self,
        files: Vec<String>,
        photograph: &Header,
        size: (u32, u32),
        turn: Orientation,
    ) -> Result<FrameMasks, IngestError> {
        let mut masks = Vec::with_capacity(files.len());
        for file in files {
            self.tree.check_time().map_err(|error| error.at(&file))?;
            let header = images::header(self.tree, &file, self.limits)?;
            // A mask is as its photograph is stored, unless it has the shape of the turned one.
            let is_turned =
                swaps_sides(turn) && !fits(header.size, photograph.size) && fits(header.size, size);
            if !is_turned && !fits(header.size, photograph.size) {
                let (mask, photograph) = (header.size, photograph.size);
                return Err(IngestErrorKind::MaskSize { mask, photograph }.at(file));
            }
            let hidden = match self.dynamic {
                Some(Dynamic::Hides(hidden)) if is_dynamic(&file) => hidden,
                Some(Dynamic::NotRead) if is_dynamic(&file) => Hidden::White,
                _ => Hidden::Black,
            };
            let bytes = self.decode_bytes(&file, &header);
            let turn = if is_turned { Orientation::NoTransforms } else { turn };
            masks.push(MaskFile { file, turn, hidden, bytes });
        }
        Ok(FrameMasks { files: masks, mode: self.mode })
    }

    /// How many masks there are, where, and what they mean.
    pub(super) fn note(&self, masks: &FoundMasks, frames: usize) -> Option<String> {
        let count = masks.count();
        if count == 0 {
            return None;
        }
        let places = masks.places.join(", ");
        let meaning = if self.mode.cuts_out {
            "is cut out: it is trained and measured as background"
        } else {
            "is ignored: it is neither learnt nor measured"
        };
        let color = match self.dynamic {
            None => "what is black in them",
            Some(Dynamic::Hides(Hidden::Black)) => "what is black in them, as white is half of them or more,",
            Some(Dynamic::Hides(Hidden::White)) => "what is white in them, as in instant-ngp's,",
            Some(Dynamic::NotRead) => {
                "what is white in them, as in instant-ngp's, or black if white is half of them or more,"
            }
        };
        let whole = match frames - count {
            0 => String::new(),
            rest => format!("; photographs without one, which count whole: {rest}"),
        };
        Some(format!("photographs with a mask: {count} ({places}); {color} {meaning}{whole}"))
    }

    /// What transparency means, of photographs that may have some. That of Blender's renders is cut out without saying.
    pub(super) fn alpha_note(&self, layout: Layout, with_alpha: usize) -> Option<String> {
        if with_alpha == 0 {
            None
        } else if self.mode.ignores_alpha {
            Some(format!(
                "photographs that may be transparent: {with_alpha}; what is transparent is ignored: it is neither learnt nor measured"
            ))
        } else if layout == Layout::Blender {
            None
        } else {
            Some(format!(
                "photographs that may be transparent: {with_alpha}; what is transparent is cut out: it is trained and measured as \
                 background. If it is to be ignored, such as people or a car's hood, choose the mask mode 'ignore'"
            ))
        }
    }
}
