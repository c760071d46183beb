//! Checkpoints in a folder: one file, always complete, replaced from time to time.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Write as _},
    path::{Path, PathBuf},
    sync::Arc,
};

use jiff::{SignedDuration, Timestamp};
use tempfile::NamedTempFile;

use super::{Checkpoint, CheckpointError};
use crate::domain::{Clock, FailurePoint, failure_point::reach};

/// Name of the file in the folder.
const FILE: &str = "checkpoint.safetensors";

/// Time between two checkpoints: the most that an interruption costs. Writing one takes a fraction of a second.
const EVERY: SignedDuration = SignedDuration::from_secs(60);

/// Saves checkpoints during a run.
pub trait CheckpointSink {
    /// Whether to save the state after `step`. The answer does not affect the run.
    fn wants(&mut self, step: u32) -> bool;

    /// Whether there is a checkpoint where it saves them. One that a run resumes from may be elsewhere.
    fn has_one(&self) -> bool {
        true
    }

    /// Saves a checkpoint.
    ///
    /// # Errors
    /// Those of the storage; the run continues all the same.
    fn save(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError>;
}

/// A folder with the newest checkpoint of one run.
pub struct CheckpointFolder {
    path: PathBuf,
    clock: Arc<dyn Clock>,
    every: SignedDuration,
    saved_at: Timestamp,
}

impl CheckpointFolder {
    /// Opens the folder, creates it if it is missing, and checks that it is writable.
    ///
    /// # Errors
    /// [`CheckpointError::Io`].
    pub fn open(path: &Path, clock: Arc<dyn Clock>) -> Result<Self, CheckpointError> {
        let io = |error| CheckpointError::io(path, error);
        fs::create_dir_all(path).map_err(io)?;
        NamedTempFile::new_in(path).map_err(io)?;
        Ok(Self { path: path.to_owned(), saved_at: clock.now(), every: EVERY, clock })
    }

    /// With another time between two checkpoints.
    #[must_use]
    pub fn every(self, every: SignedDuration) -> Self {
        Self { every, ..self }
    }

    /// The checkpoint in the folder `path`.
    ///
    /// # Errors
    /// [`CheckpointError::Missing`] if there is none; others if it is invalid.
    pub fn load(path: &Path) -> Result<Checkpoint, CheckpointError> {
        let file = path.join(FILE);
        match fs::read(&file) {
            Ok(bytes) => Checkpoint::from_bytes(&bytes),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Err(CheckpointError::Missing(file)),
            Err(error) => Err(CheckpointError::io(&file, error)),
        }
    }

    /// Removes the checkpoint in the folder `path`, if there is one.
    pub fn clear(path: &Path) {
        let file = path.join(FILE);
        match fs::remove_file(&file) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => tracing::warn!("{} not removed: {error}", file.display()),
        }
    }
}

impl CheckpointSink for CheckpointFolder {
    fn wants(&mut self, _step: u32) -> bool {
        // A clock that was set back must not delay the next one for hours.
        self.clock.now().duration_since(self.saved_at).abs() >= self.every
    }

    fn has_one(&self) -> bool {
        self.path.join(FILE).exists()
    }

    fn save(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
        // Also after a failure, or every step would retry.
        self.saved_at = self.clock.now();
        let io = |error| CheckpointError::io(&self.path, error);
        let file = NamedTempFile::new_in(&self.path).map_err(io)?;
        let mut out = BufWriter::with_capacity(1 << 20, file.as_file());
        checkpoint.write(&mut out).and_then(|()| out.flush()).map_err(io)?;
        drop(out);
        file.as_file().sync_all().map_err(io)?;
        reach(FailurePoint::BeforeCheckpoint);
        file.persist(self.path.join(FILE)).map_err(|error| io(error.error))?;
        // Syncs the folder, so that the new name is on the disk.
        #[cfg(unix)]
        File::open(&self.path).and_then(|folder| folder.sync_all()).map_err(io)?;
        reach(FailurePoint::AfterCheckpoint);
        Ok(())
    }
}
