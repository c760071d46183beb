//! The worker processes of a service, as its API sees them.

use super::{JobId, Layout};

/// The worker processes that a service keeps.
pub trait Workers: Send + Sync {
    /// How many there are.
    fn counts(&self) -> WorkerCounts;

    /// Removes the files of a deleted job outside the store and its blobs; blocks.
    fn forget(&self, job: JobId);
}

/// Numbers of worker processes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WorkerCounts {
    /// How many there should be; 0 if others run them.
    pub expected: usize,
    /// How many are alive.
    pub alive: usize,
}

/// The work that a dataset needs before training, or that a worker can do. Each includes those before it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Preparation {
    /// None: the dataset has cameras.
    #[default]
    None,
    /// The cameras of photographs are found.
    Poses,
    /// Photographs are taken from a video, and their cameras found.
    Video,
}

impl Preparation {
    /// Every one, in order.
    pub const ALL: [Self; 3] = [Self::None, Self::Poses, Self::Video];

    /// The work that a dataset of a layout needs.
    #[must_use]
    pub fn of(layout: Layout) -> Self {
        match layout {
            Layout::Blender | Layout::Nerfstudio | Layout::Colmap => Self::None,
            Layout::Photographs => Self::Poses,
            Layout::Video => Self::Video,
        }
    }
}
