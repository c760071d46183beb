//! Checkpoints in a folder: one file, always a whole one, replaced now and then.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Write as _},
    path::{Path, PathBuf},
    sync::Arc,
};

use jiff::{SignedDuration, Timestamp};
use tempfile::NamedTempFile;

use super::{Checkpoint, CheckpointError};
use crate::domain::Clock;

/// Name of the file in the folder.
const FILE: &str = "checkpoint.safetensors";

/// Time between two checkpoints: what an interruption costs at most, against a fraction of a second for each.
const EVERY: SignedDuration = SignedDuration::from_secs(60);

/// Takes checkpoints while a run goes on.
pub trait KeepCheckpoints {
    /// Whether the state after `step` is to be kept. The answer decides nothing about the run itself.
    fn wants(&mut self, step: u32) -> bool;

    /// Keeps it.
    ///
    /// # Errors
    /// Why it could not; the run goes on all the same.
    fn keep(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError>;
}

/// A folder with the newest checkpoint of one run.
pub struct CheckpointFolder {
    path: PathBuf,
    clock: Arc<dyn Clock>,
    kept_at: Timestamp,
}

impl CheckpointFolder {
    /// Opens the folder, which is made if it is missing, and tries whether it can be written.
    ///
    /// # Errors
    /// [`CheckpointError::Io`].
    pub fn open(path: &Path, clock: Arc<dyn Clock>) -> Result<Self, CheckpointError> {
        let io = |fault| CheckpointError::io(path, fault);
        fs::create_dir_all(path).map_err(io)?;
        NamedTempFile::new_in(path).map_err(io)?;
        Ok(Self { path: path.to_owned(), kept_at: clock.now(), clock })
    }

    /// The checkpoint in the folder `path`.
    ///
    /// # Errors
    /// [`CheckpointError::Missing`] if there is none; what is wrong with it.
    pub fn load(path: &Path) -> Result<Checkpoint, CheckpointError> {
        let file = path.join(FILE);
        match fs::read(&file) {
            Ok(bytes) => Checkpoint::from_bytes(&bytes),
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => Err(CheckpointError::Missing(file)),
            Err(fault) => Err(CheckpointError::io(&file, fault)),
        }
    }
}

impl CheckpointFolder {
    /// Removes the checkpoint in the folder `path`, if there is one: what it was kept for has been reached.
    pub fn clear(path: &Path) {
        let file = path.join(FILE);
        match fs::remove_file(&file) {
            Ok(()) => {}
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => {}
            Err(fault) => tracing::warn!("{} stays: {fault}", file.display()),
        }
    }
}

impl KeepCheckpoints for CheckpointFolder {
    fn wants(&mut self, _step: u32) -> bool {
        // A clock that was set back must not put the next one off for hours.
        self.clock.now().duration_since(self.kept_at).abs() >= EVERY
    }

    fn keep(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
        // Also after a failure, or every step would try again.
        self.kept_at = self.clock.now();
        let io = |fault| CheckpointError::io(&self.path, fault);
        let file = NamedTempFile::new_in(&self.path).map_err(io)?;
        let mut out = BufWriter::with_capacity(1 << 20, file.as_file());
        checkpoint.write(&mut out).and_then(|()| out.flush()).map_err(io)?;
        drop(out);
        file.as_file().sync_all().map_err(io)?;
        file.persist(self.path.join(FILE)).map_err(|fault| io(fault.error))?;
        // The new name is on the disk only when the folder is.
        #[cfg(unix)]
        File::open(&self.path).and_then(|folder| folder.sync_all()).map_err(io)?;
        Ok(())
    }
}
