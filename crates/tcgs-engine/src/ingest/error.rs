//! The reasons for refusing a dataset, one variant each, and the HTTP problem of each.
//!
//! A message says what is wrong with which values; the file is in [`IngestError::file`].

use std::io;

use thiserror::Error;

pub use super::error_text::MissingHint;
pub(super) use super::error_text::{several, shown};
use super::{
    error_text::{missing_images, photographs_alone},
    limits::Limits,
};
use crate::domain::{Bytes, CameraError, Problem, ProblemType, is_no_space};

/// Why a dataset is refused, and which file.
#[derive(Debug, Error)]
#[error("{}{kind}", file.as_ref().map(|file| format!("{file}: ")).unwrap_or_default())]
pub struct IngestError {
    /// The file that is wrong, relative to the dataset's root, if it is one.
    pub file: Option<String>,
    /// What is wrong.
    pub kind: IngestErrorKind,
}

/// Result of reading a file whose name the caller adds with [`IngestErrorKind::at`].
pub(super) type Result<T, E = IngestErrorKind> = std::result::Result<T, E>;

/// What can be wrong with a dataset.
#[derive(Debug, Error)]
pub enum IngestErrorKind {
    /// The path does not exist.
    #[error("there is no such file or directory")]
    NotFound,
    /// The operating system refused to read it.
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),

    /// Neither a directory nor a zip archive.
    #[error("this is not a zip archive ({0}); send the dataset as one zip file")]
    NotAZip(String),
    /// The archive's structure or an entry's data is damaged.
    #[error("the archive is damaged: {0}")]
    CorruptArchive(String),
    /// An entry needs a password.
    #[error("is encrypted; make the zip without a password")]
    Encrypted,
    /// An entry uses a compression method that is not read here.
    #[error("uses compression method {0}; only stored and deflated entries are read")]
    Compression(String),
    /// A name that leaves the dataset or is not portable.
    #[error("the name is not safe: {0}")]
    UnsafeName(&'static str),
    /// A symbolic link, device, pipe or socket.
    #[error("is a {0}, which is not followed; put the file itself there")]
    NotARegularFile(&'static str),
    /// Two entries of one name.
    #[error("the archive has this name twice")]
    DuplicateEntry,
    /// Entries share bytes, which only crafted archives do.
    #[error("entries of the archive overlap")]
    OverlappingEntries,
    /// More files than are accepted.
    #[error("has more than {limit} entries")]
    TooManyEntries {
        /// Most entries that are accepted.
        limit: usize,
    },
    /// The list of an archive's entries is too long.
    #[error(
        "the list of its entries takes {bytes} bytes; at most {limit} are accepted. Send fewer files, or shorter names"
    )]
    DirectoryTooLarge {
        /// Bytes of the central directory, as the archive states them.
        bytes: u64,
        /// Most bytes that are accepted.
        limit: u64,
    },
    /// A table that lists more frames or cameras than are accepted.
    #[error("lists more than {limit} {what}, which is the most that is accepted")]
    TooManyRecords {
        /// What is listed.
        what: &'static str,
        /// Most that are accepted.
        limit: usize,
    },
    /// A table whose file names are too long together.
    #[error("the file names in it have more than {limit} bytes together, which is the most that is accepted")]
    TooManyNameBytes {
        /// Most bytes that are accepted.
        limit: usize,
    },
    /// A point cloud of more points than are accepted.
    #[error("has more than {limit} points; thin the cloud out")]
    TooManyPoints {
        /// Most points that are accepted.
        limit: usize,
    },
    /// A check that took too long.
    #[error(
        "the check of the dataset was ended after {seconds} s; photographs and their tables take a fraction of that. Send \
         smaller tables and fewer files"
    )]
    CheckTimeout {
        /// How long it may take.
        seconds: u64,
    },
    /// Too many checks at a time.
    #[error("other datasets are being checked; try again later")]
    ChecksBusy,
    /// The files are too large together.
    #[error("the files have {bytes} bytes together; at most {limit} are accepted")]
    TooManyBytes {
        /// Unpacked bytes of all files, as the archive states them.
        bytes: u64,
        /// Most bytes that are accepted.
        limit: u64,
    },
    /// One file is too large.
    #[error("has {bytes} bytes; at most {limit} are accepted in one file")]
    FileTooLarge {
        /// Size of the file.
        bytes: u64,
        /// Most bytes that are accepted.
        limit: u64,
    },
    /// An entry that unpacks to far more than photographs or tables do.
    #[error("unpacks to {ratio} times its packed size; at most {limit} times is accepted")]
    CompressionRatio {
        /// Unpacked over packed size, rounded down.
        ratio: u64,
        /// Largest accepted ratio.
        limit: u64,
    },

    /// None of the three layouts.
    #[error(
        "no dataset was found: no folder has a transforms.json, a transforms_train.json, or cameras and images of COLMAP \
         (.bin or .txt){}",
        photographs_alone(*photographs, unread.as_ref())
    )]
    NoLayout {
        /// Photographs that are there.
        photographs: usize,
        /// The format of others that are not read, and a command that converts them.
        unread: Option<(&'static str, String)>,
    },
    /// More than one dataset.
    #[error("there are {count} datasets, in {}: send one of them", several(*count, first))]
    SeveralDatasets {
        /// How many there are.
        count: usize,
        /// The folders of the first.
        first: Vec<String>,
    },
    /// Too few photographs to find their cameras.
    #[error(
        "there are {0} photographs without cameras, which are found of {least} or more; 50 and more, taken all around, make a \
         good scene",
        least = Limits::MIN_PHOTOGRAPHS
    )]
    TooFewPhotographs(usize),
    /// Too many photographs to find their cameras.
    #[error("there are {count} photographs; cameras are found of at most {limit}")]
    TooManyPhotographs {
        /// How many there are.
        count: usize,
        /// Most that are accepted.
        limit: usize,
    },
    /// A second video.
    #[error("is a second video; send each alone, or take photographs from both first")]
    SeveralVideos,
    /// Not the container that the extension says.
    #[error("is not an MP4 or QuickTime video")]
    NotAVideo,
    /// A file that the layout needs is not there.
    #[error("the file is missing; {0}")]
    MissingFile(&'static str),
    /// Images that the layout lists are not there.
    #[error("{}", missing_images(*count, *listed, first, hint.as_ref()))]
    MissingImages {
        /// How many are missing.
        count: usize,
        /// How many are listed.
        listed: usize,
        /// The first few of them.
        first: Vec<String>,
        /// Why they may be missing.
        hint: Option<MissingHint>,
    },
    /// No image to train on.
    #[error("lists no images to train on")]
    NoImages,
    /// One name or image file for two frames.
    #[error("'{0}' is listed twice; every frame needs its own image and name")]
    DuplicateName(String),
    /// A split list that names no frame.
    #[error("{list} names '{name}', which is not among the frames")]
    UnknownFrame {
        /// The key of the list.
        list: &'static str,
        /// The name in it.
        name: String,
    },
    /// Not JSON, or not of the expected shape. The message carries line and column.
    #[error("is not a valid transforms file: {0}")]
    Json(#[from] serde_json::Error),
    /// Text of a JSON file that is not given to a parser.
    #[error("is not a valid transforms file: line {line}: {message}")]
    JsonText {
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        message: &'static str,
    },
    /// A table in another encoding.
    #[error("is UTF-16 text; save it as UTF-8")]
    Utf16,
    /// A value in a JSON file that cannot be used.
    #[error("{pointer}: {message}")]
    Field {
        /// JSON pointer.
        pointer: String,
        /// What is wrong with the value.
        message: String,
    },
    /// Masks in a form that is not understood.
    #[error(
        "{place}: masks are named here, but not by the path of one image or of a folder; state it as mask_path, or train without \
         masks (masks=none)"
    )]
    Masks {
        /// Where they are.
        place: String,
    },
    /// A mask that a file states is not in the dataset.
    #[error("{place}: the mask '{path}' is missing; add it, or train without masks (masks=none)")]
    MissingMask {
        /// The field that states it.
        place: String,
        /// The path.
        path: String,
    },
    /// A folder of masks without masks of the photographs.
    #[error(
        "{folder}/ looks like a folder of masks, but none of its images ({images}) has the name of a photograph: name the mask of \
         'a.jpg' 'a.jpg.png' or 'a.png', rename the folder, or train without masks (masks=none)"
    )]
    NoMaskMatches {
        /// The folder.
        folder: String,
        /// How many images it has.
        images: usize,
    },
    /// There is no image in the folder that the option `masks` names.
    #[error("masks: there is no image in '{folder}/'; name a folder of the dataset, auto or none")]
    NoMaskFolder {
        /// The folder.
        folder: String,
    },
    /// A mask whose name several photographs have.
    #[error(
        "several photographs have the name of this mask; put masks into folders as the photographs are: the mask of \
         'images/left/a.jpg' into 'masks/left/'"
    )]
    AmbiguousMask,
    /// More masks for one photograph than are read.
    #[error("this is one mask too many of its photograph: at most {limit} are read for one")]
    TooManyMasks {
        /// The limit.
        limit: usize,
    },
    /// A mask of other proportions than its photograph.
    #[error(
        "the mask has {mask:?} pixels and its photograph {photograph:?}; it must have the same size or the same proportions"
    )]
    MaskSize {
        /// Width and height of the mask.
        mask: (u32, u32),
        /// Width and height of the photograph.
        photograph: (u32, u32),
    },
    /// Masks that leave nothing to train on.
    #[error(
        "masks hide every pixel of every photograph to train on; black is hidden: are black and white swapped?"
    )]
    AllHidden,
    /// A camera model without a pinhole equivalent here.
    #[error(
        "{place}: camera model {model} is not supported; supported are those of COLMAP 4.2 and nerfstudio that show less than \
         a half-space. Undistort the images first (`colmap image_undistorter`)"
    )]
    CameraModel {
        /// Where in the file.
        place: String,
        /// The model as the file names it.
        model: String,
    },
    /// A camera model of panoramas, or without a center.
    #[error(
        "{place}: {model} pictures show more than a perspective one can, which is what is trained on. Make perspective pictures \
         of them first: COLMAP's `python/examples/panorama_sfm.py`, or `ns-process-data images --camera-type equirectangular`"
    )]
    Panorama {
        /// Where in the file.
        place: String,
        /// The model as the file names it.
        model: String,
    },
    /// A camera or pose that describes no camera.
    #[error("{place}: {source}")]
    Camera {
        /// Where in the file.
        place: String,
        /// What is wrong.
        source: CameraError,
    },
    /// A finite value far outside of what any camera has, which single precision could not work with.
    #[error("{what} is {value:e}, which is outside of any real camera's range ({range})")]
    Implausible {
        /// Which value.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What is accepted.
        range: &'static str,
    },
    /// Distortion coefficients that are not finite.
    #[error("{place}: a distortion coefficient is not finite")]
    NonFiniteDistortion {
        /// Where in the file.
        place: String,
    },
    /// Undistortion would leave less than half of the image.
    #[error(
        "the lens distortion is too strong for a pinhole camera: less than half of the width or height \
         would remain. Undistort the images first"
    )]
    DistortionTooStrong,
    /// A binary file that ends early.
    #[error("ends early: {what} at byte {offset} needs {needed} bytes and {left} are left")]
    Truncated {
        /// What was being read.
        what: &'static str,
        /// Where it starts.
        offset: usize,
        /// Its size.
        needed: usize,
        /// Bytes that are left.
        left: usize,
    },
    /// A count that the file cannot hold.
    #[error("claims {count} {what}, which need at least {needed} bytes; {left} are left")]
    Count {
        /// What is counted.
        what: &'static str,
        /// The claimed count.
        count: u64,
        /// Fewest bytes that many can take.
        needed: u128,
        /// Bytes that are left.
        left: usize,
    },
    /// Bytes after the last record.
    #[error("has {0} unexpected bytes after the last record")]
    TrailingBytes(usize),
    /// A record of a binary or text table that cannot be used.
    #[error("{place}: {message}")]
    Record {
        /// Which line or record.
        place: String,
        /// What is wrong with it.
        message: String,
    },
    /// A PLY file that holds no usable point cloud.
    #[error("is not a usable point cloud: {0}")]
    Ply(String),

    /// An image whose header or pixels cannot be decoded.
    #[error("is not a readable PNG, JPEG or WebP image: {0}")]
    Image(String),
    /// An image of a known format that is not read.
    #[error(
        "is {} {format} image, which is not read; convert the photographs to PNG or JPEG (`{remedy}`). Tables may keep the old names",
        if matches!(*format, "TIFF" | "BMP" | "GIF" | "JPEG XL" | "HEIC") { "a" } else { "an" }
    )]
    UnreadFormat {
        /// The format.
        format: &'static str,
        /// A command that converts such files.
        remedy: String,
    },
    /// An image whose header cannot be found near its beginning.
    #[error(
        "no PNG, JPEG or WebP header ends within its first {limit} bytes ({message}); if the image opens elsewhere, remove \
         the previews and metadata in it (`exiftool -all= FILE`)"
    )]
    ImageHeader {
        /// How much is looked at.
        limit: u64,
        /// What the decoder says.
        message: String,
    },
    /// An image of another size than its camera.
    #[error(
        "the image has {}x{} pixels and its camera {}x{}; the sizes must be equal, or the image an evenly \
         scaled-down copy", actual.0, actual.1, stated.0, stated.1
    )]
    ImageSize {
        /// Stored size.
        actual: (u32, u32),
        /// Size that the camera states.
        stated: (u32, u32),
    },
    /// An image stored on its side.
    #[error(
        "the image has {}x{} pixels and its camera {}x{}: one of them is turned by 90 degrees. If the image has an EXIF \
         orientation, apply it or ignore it as the camera's program did (exif_orientation); else turn the pixels", actual.0,
        actual.1, stated.0, stated.1
    )]
    ImageRotated {
        /// Stored size.
        actual: (u32, u32),
        /// Size that the camera states.
        stated: (u32, u32),
    },
    /// One image that is too wide or too high.
    #[error("the image has a side of more than {limit} pixels, which is the longest that is accepted")]
    SideTooLong {
        /// Longest side that is accepted, in pixels.
        limit: u32,
    },
    /// One image with too many pixels.
    #[error("the image has {pixels} pixels; at most {limit} are accepted")]
    TooManyPixels {
        /// Pixels of the image.
        pixels: u64,
        /// Most that are accepted.
        limit: u64,
    },
    /// One image that memory has no room to decode.
    #[error(
        "decoding the image takes up to {bytes} of memory, and there are {budget} for reading photographs; allow \
         more with --host-memory, or make the images smaller"
    )]
    DecodeMemory {
        /// The most that it may take.
        bytes: Bytes,
        /// What there is for all images.
        budget: Bytes,
    },
    /// The disk has no room for what memory has no room for.
    #[error(
        "the photographs do not fit into memory, and the disk for temporary files has no room for {bytes} bytes more; \
         make room there, or allow more memory with --host-memory"
    )]
    SpillFull {
        /// Bytes of the photograph that did not fit.
        bytes: u64,
    },
    /// The temporary file cannot be written.
    #[error("the photographs do not fit into memory, and no temporary file can be written: {0}")]
    Spill(#[source] io::Error),
    /// A file that is made of the dataset's cannot be written.
    #[error("a file for the search of cameras cannot be written: {0}")]
    Write(#[source] io::Error),
    /// The caller asked to stop.
    #[error("the reading of the dataset was stopped")]
    Stopped,
    /// Too many pixels in all images together.
    #[error("the images have {pixels} pixels together after downscaling; at most {limit} are accepted")]
    TooManyScenePixels {
        /// Pixels of all images.
        pixels: u64,
        /// Most that are accepted.
        limit: u64,
    },
}

impl IngestErrorKind {
    /// The error in this file.
    pub(super) fn at(self, file: impl Into<String>) -> IngestError {
        IngestError { file: Some(file.into()), kind: self }
    }

    /// The type of the problem that reports this error.
    fn problem_type(&self) -> ProblemType {
        match self {
            Self::NotFound => ProblemType::DatasetNotFound,
            Self::Io(_) => ProblemType::DatasetUnreadable,
            Self::DecodeMemory { .. } => ProblemType::HostMemory,
            Self::Stopped => ProblemType::ReadingStopped,
            Self::SpillFull { .. } => ProblemType::StorageFull,
            Self::Write(error) if is_no_space(error) => ProblemType::StorageFull,
            Self::Spill(_) | Self::Write(_) => ProblemType::StorageFailed,
            Self::NotAZip(_) => ProblemType::NotAZip,
            Self::CorruptArchive(_)
            | Self::Encrypted
            | Self::Compression(_)
            | Self::UnsafeName(_)
            | Self::NotARegularFile(_)
            | Self::DuplicateEntry
            | Self::OverlappingEntries => ProblemType::ArchiveRejected,
            Self::ChecksBusy => ProblemType::Busy,
            Self::TooManyEntries { .. }
            | Self::DirectoryTooLarge { .. }
            | Self::TooManyRecords { .. }
            | Self::TooManyNameBytes { .. }
            | Self::TooManyPoints { .. }
            | Self::CheckTimeout { .. }
            | Self::TooManyBytes { .. }
            | Self::FileTooLarge { .. }
            | Self::CompressionRatio { .. }
            | Self::SideTooLong { .. }
            | Self::TooManyPhotographs { .. }
            | Self::TooManyPixels { .. }
            | Self::TooManyScenePixels { .. } => ProblemType::DatasetTooLarge,
            Self::Json(_)
            | Self::JsonText { .. }
            | Self::Utf16
            | Self::Field { .. }
            | Self::Truncated { .. }
            | Self::Count { .. }
            | Self::TrailingBytes(_)
            | Self::Record { .. } => ProblemType::TableRejected,
            Self::CameraModel { .. }
            | Self::Panorama { .. }
            | Self::Camera { .. }
            | Self::Implausible { .. }
            | Self::NonFiniteDistortion { .. }
            | Self::DistortionTooStrong => ProblemType::CameraRejected,
            Self::Ply(_) => ProblemType::PointsRejected,
            Self::Image(_)
            | Self::UnreadFormat { .. }
            | Self::ImageHeader { .. }
            | Self::ImageSize { .. }
            | Self::ImageRotated { .. } => ProblemType::ImageRejected,
            Self::TooFewPhotographs(_) => ProblemType::TooFewPhotographs,
            Self::NoLayout { .. }
            | Self::SeveralVideos
            | Self::NotAVideo
            | Self::SeveralDatasets { .. }
            | Self::MissingFile(_)
            | Self::MissingImages { .. }
            | Self::NoImages
            | Self::DuplicateName(_)
            | Self::UnknownFrame { .. }
            | Self::MissingMask { .. }
            | Self::NoMaskMatches { .. }
            | Self::NoMaskFolder { .. }
            | Self::AmbiguousMask
            | Self::Masks { .. }
            | Self::TooManyMasks { .. }
            | Self::MaskSize { .. }
            | Self::AllHidden => ProblemType::DatasetRejected,
        }
    }
}

impl From<IngestErrorKind> for IngestError {
    fn from(kind: IngestErrorKind) -> Self {
        Self { file: None, kind }
    }
}

impl From<IngestError> for Problem {
    fn from(error: IngestError) -> Self {
        let problem = Problem::new(error.kind.problem_type(), error.kind.to_string());
        match error.file {
            Some(file) => problem.in_file(shown(&file)),
            None => problem,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_problem_carries_status_file_and_fault() {
        let problem = Problem::from(IngestErrorKind::Encrypted.at("images/a.png"));
        assert_eq!((problem.status, problem.file.as_deref()), (422, Some("images/a.png")));
        assert_eq!(problem.kind, "urn:tcgs:problem:archive-rejected");
        let problem = Problem::from(IngestError::from(IngestErrorKind::NotAZip("no end record".into())));
        assert_eq!((problem.status, problem.file), (400, None));
        assert_eq!(
            Problem::from(IngestError::from(IngestErrorKind::TooManyEntries { limit: 1 })).status,
            413
        );
    }

    #[test]
    fn hostile_names_are_shown_short_and_printable() {
        let name = format!("a\u{1b}[2J{}", "x".repeat(1000));
        let file = Problem::from(IngestErrorKind::Encrypted.at(name)).file.expect("a file");
        assert!(file.starts_with("a\u{fffd}[2J"), "{file}");
        assert_eq!(file.chars().count(), super::super::error_text::MAX_NAME_CHARS_SHOWN + 1);
    }
}
