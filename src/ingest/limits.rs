//! How much a dataset may hold. Everything is checked before the memory for it is asked for.

/// Bounds on what is read from a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Entries of the archive or the directory tree, folders and litter included.
    pub entries: usize,
    /// Unpacked bytes of all files together.
    pub total_bytes: u64,
    /// Unpacked bytes of one file.
    pub file_bytes: u64,
    /// Unpacked over packed size of one archive entry; only entries above [`Limits::RATIO_FREE_BYTES`] are judged.
    pub ratio: u64,
    /// Pixels of one stored image.
    pub image_pixels: u64,
    /// Pixels of all images together, as they are kept for training.
    pub scene_pixels: u64,
}

impl Limits {
    /// Entries up to this size may have any compression ratio: they cost nothing and small tables pack well.
    pub const RATIO_FREE_BYTES: u64 = 1 << 20;

    /// Images wider than this are downscaled to it (method.md §1.1), pixels.
    pub const TRAINING_WIDTH: u32 = 1600;
}

impl Default for Limits {
    /// Room for some thousands of photographs: 64 Mi pixels an image, 8 Gi pixels a scene, which is a thousand upright
    /// 4K frames twice over. As RGB those are 24 GiB; what does not fit into memory goes to disk ([`super::Room`]).
    fn default() -> Self {
        Self {
            entries: 100_000,
            total_bytes: 64 << 30,
            file_bytes: 2 << 30,
            ratio: 200,
            image_pixels: 64 << 20,
            scene_pixels: 8 << 30,
        }
    }
}
