//! Errors of encoding and decoding, one variant for each thing that can be wrong.

use thiserror::Error;

use crate::domain::Digest;
use crate::domain::anchors::SceneShapeError;

/// Result of reading a part of a file.
pub(super) type Result<T, E = DecodeError> = std::result::Result<T, E>;

/// A scene or settings that cannot be written.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum EncodeError {
    /// The parts of the scene do not fit together or are not finite.
    #[error(transparent)]
    Shape(#[from] SceneShapeError),
    /// No anchor has an offset that is kept.
    #[error("the scene has no anchor with a kept offset: there is nothing to encode")]
    Empty,
    /// A quantization step or lattice value that no decoder could use.
    #[error("{name} is {value}: it must be a positive, finite number of ordinary size")]
    Setting {
        /// Which one.
        name: &'static str,
        /// Its value.
        value: f32,
    },
    /// A count beyond the range of the format.
    #[error("{what}: {value} is more than the format's {limit}")]
    TooLarge {
        /// What was counted.
        what: &'static str,
        /// How many.
        value: u64,
        /// The format's limit.
        limit: u64,
    },
    /// A value so far from zero that its integer would not be exact in an f32.
    #[error("{what}[{index}] = {value} is beyond 2^24 steps of {step}: use a larger step")]
    OutOfRange {
        /// Which array.
        what: &'static str,
        /// Where in the array.
        index: usize,
        /// The value.
        value: f32,
        /// The quantization step.
        step: f32,
    },
    /// A scaling below zero.
    #[error("scalings[{index}] = {value}: scalings are linear and must not be negative")]
    NegativeScaling {
        /// Where in the array.
        index: usize,
        /// The value.
        value: f32,
    },
    /// A context candidate does not fit the scene or exceeds the format, or a choice names one that does not exist.
    #[error("the context's {what} cannot be used: {problem}")]
    Candidate {
        /// Which part.
        what: String,
        /// What is wrong.
        problem: String,
    },
    /// Two anchors in one cell.
    #[error("cell {cell:?} has more than one anchor")]
    DuplicateCell {
        /// The cell.
        cell: [i32; 3],
    },
    /// The written file does not decode to what was quantized: a bug of this program.
    #[error("the written file does not decode to the quantized scene; please report this")]
    Verification,
    /// The written file does not decode at all: a bug of this program, or a scene beyond the decoder's limits.
    #[error("the written file cannot be read back: {0}")]
    ReadBack(#[source] DecodeError),
}

/// Bytes that are not a `.tcgs` file that this version can read.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum DecodeError {
    /// The first eight bytes are not the magic.
    #[error("not a .tcgs file: it does not start with the .tcgs signature")]
    NotTcgs,
    /// The file or a part of it ends too early.
    #[error("{part} ends early: {what} at byte {offset} needs {needed} bytes, {left} are left")]
    Truncated {
        /// Header or section.
        part: &'static str,
        /// The field.
        what: &'static str,
        /// Offset within the part.
        offset: usize,
        /// Bytes that the field needs.
        needed: u64,
        /// Bytes left in the part.
        left: u64,
    },
    /// A later format.
    #[error("the file is of format version {major}.{minor}; this program reads version {known}.x")]
    UnsupportedVersion {
        /// Major version of the file.
        major: u16,
        /// Minor version of the file.
        minor: u16,
        /// Major version that is known.
        known: u16,
    },
    /// Integer arithmetic of another version: decoding with this one would give another scene.
    #[error("the file needs arithmetic profile {profile}; this program knows profile {known}")]
    UnsupportedProfile {
        /// Profile of the file.
        profile: u16,
        /// Profile that is known.
        known: u16,
    },
    /// The length in the header is not the file's.
    #[error("the header states {stated} bytes, the file has {actual}: it was cut or something was appended")]
    FileLength {
        /// In the header.
        stated: u64,
        /// Of the file.
        actual: u64,
    },
    /// The header is damaged.
    #[error("the header is damaged: its CRC32C is {actual:08x} where {stated:08x} is stated")]
    HeaderChecksum {
        /// In the file.
        stated: u32,
        /// Computed.
        actual: u32,
    },
    /// The file is damaged.
    #[error("the file is damaged: its SHA-256 is {actual} where {stated} is stated")]
    FileDigest {
        /// In the file.
        stated: Digest,
        /// Computed.
        actual: Digest,
    },
    /// A section is damaged.
    #[error("section {section} is damaged: its CRC32C is {actual:08x} where {stated:08x} is stated")]
    SectionChecksum {
        /// Section.
        section: String,
        /// In the file.
        stated: u32,
        /// Computed.
        actual: u32,
    },
    /// A chunk is damaged.
    #[error("attribute chunk {chunk} is damaged: its CRC32C is {actual:08x} where {stated:08x} is stated")]
    ChunkChecksum {
        /// Chunk.
        chunk: usize,
        /// In the file.
        stated: u32,
        /// Computed.
        actual: u32,
    },
    /// A section that must be understood and is not.
    #[error("the file needs section {section}, which this program does not know: use a newer version")]
    UnknownSection {
        /// Section.
        section: String,
    },
    /// A section that every file has is absent.
    #[error("section {section} is missing")]
    MissingSection {
        /// Section.
        section: &'static str,
    },
    /// A section that the manifest has no use for.
    #[error("section {section} has no place in this file: no attribute is predicted from it")]
    NeedlessSection {
        /// Section.
        section: &'static str,
    },
    /// Two sections of one name.
    #[error("section {section} occurs twice")]
    DuplicateSection {
        /// Section.
        section: String,
    },
    /// Sections leave a gap, overlap or leave the file.
    #[error("section {section} starts at byte {offset} where byte {expected} is due")]
    SectionPlace {
        /// Section.
        section: String,
        /// Stated start.
        offset: u64,
        /// End of the preceding section.
        expected: u64,
    },
    /// Bytes after the end of a part's content.
    #[error("{part} has {count} bytes after its end")]
    TrailingBytes {
        /// Header or section.
        part: &'static str,
        /// How many.
        count: usize,
    },
    /// An entropy-coded stream that does not end where its symbols end.
    #[error("{part}: the coded stream {problem}")]
    Stream {
        /// Section.
        part: &'static str,
        /// What is wrong.
        problem: &'static str,
    },
    /// A value that the format does not allow.
    #[error("{part}: {what} is {value}, which the format does not allow")]
    Malformed {
        /// Section.
        part: &'static str,
        /// The field.
        what: &'static str,
        /// Its value, or a description.
        value: String,
    },
    /// More than the caller is willing to decode.
    #[error("{what}: {value} is over the limit of {limit}")]
    Limit {
        /// What is counted.
        what: &'static str,
        /// How much the file asks for.
        value: u64,
        /// The limit.
        limit: u64,
    },
    /// The allocator refused.
    #[error("not enough memory for {bytes} bytes of {what}")]
    OutOfMemory {
        /// For what.
        what: &'static str,
        /// How much.
        bytes: u64,
    },
    /// The decoded attributes are not those that the encoder saw.
    #[error("the decoded attributes hash to {actual} where the file states {stated}")]
    DecodeDigest {
        /// In the file.
        stated: Digest,
        /// Computed.
        actual: Digest,
    },
}

impl DecodeError {
    /// A value of `part` that the format does not allow.
    pub(super) fn malformed(part: &'static str, what: &'static str, value: impl ToString) -> Self {
        Self::Malformed { part, what, value: value.to_string() }
    }
}
