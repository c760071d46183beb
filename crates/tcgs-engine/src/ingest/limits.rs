//! Limits on the content of a dataset. Each is checked before the memory for it is allocated.
//!
//! Everything else is read as a stream, so the memory of a check depends on these numbers and not on the size of a file.

/// Limits on the content of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Entries of the archive or the directory tree, folders and files of the operating system included.
    pub entries: usize,
    /// Bytes of an archive's central directory, which lists its entries and is held in memory.
    pub directory_bytes: u64,
    /// Unpacked bytes of all files together.
    pub total_bytes: u64,
    /// Unpacked bytes of one file.
    pub file_bytes: u64,
    /// Bytes of one file of JSON.
    pub json_bytes: u64,
    /// Unpacked over packed size of one archive entry; only checked for entries above [`Limits::RATIO_FREE_BYTES`].
    pub ratio: u64,
    /// Points of a dataset.
    pub points: usize,
    /// Pixels of one stored image.
    pub image_pixels: u64,
    /// Pixels of all images together, as they are kept for training.
    pub scene_pixels: u64,
}

impl Limits {
    /// Entries up to this size may have any compression ratio: they are cheap, and small tables pack well.
    pub const RATIO_FREE_BYTES: u64 = 1 << 20;

    /// Frames that a table may list, and cameras. Each takes about 2 KiB of memory while a dataset is checked.
    pub const FRAMES: usize = 20_000;

    /// Fewest photographs of which cameras can be found.
    pub const MIN_PHOTOGRAPHS: usize = 3;

    /// Bytes of all file names together that a table may list.
    pub const NAME_BYTES: usize = 6 << 20;

    /// Bytes of an image within which its header must be.
    pub const HEADER_BYTES: u64 = 1 << 20;
}

impl Default for Limits {
    /// Enough for some thousands of photographs: 64 Mi pixels an image, 8 Gi pixels a scene, which is a thousand upright
    /// 4K frames twice over. As RGB those are 24 GiB; what does not fit into memory goes to disk ([`super::LoadBudget`]).
    ///
    /// A central directory of 6 MiB has some 50 000 entries of usual names. Its index takes up to ten times as much memory.
    fn default() -> Self {
        Self {
            entries: 100_000,
            directory_bytes: 6 << 20,
            total_bytes: 64 << 30,
            file_bytes: 2 << 30,
            json_bytes: 64 << 20,
            ratio: 200,
            points: 32 << 20,
            image_pixels: 64 << 20,
            scene_pixels: 8 << 30,
        }
    }
}
