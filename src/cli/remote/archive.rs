//! The dataset archive that is uploaded.

use std::{
    fs::File,
    io::{Read as _, Seek as _, SeekFrom},
    path::{Path, PathBuf},
};

use tcgs::ingest;

use crate::cli::{CliError, wiring};

/// A zip file: the one named on the command line, or a temporary one of the folder named there.
pub(super) struct Archive {
    file: File,
    pub(super) bytes: u64,
    name: PathBuf,
}

impl Archive {
    pub(super) fn open(dataset: &Path) -> Result<Self, CliError> {
        let unreadable = |error| CliError::unreadable(dataset, &error);
        let file = if dataset.is_dir() {
            let temporary = ingest::large_file_dir();
            let mut file = tempfile::tempfile_in(&temporary)
                .map_err(|error| CliError::unwritable(&temporary, &error))?;
            wiring::pack(dataset, &mut file)?;
            file
        } else {
            File::open(dataset).map_err(unreadable)?
        };
        let bytes = file.metadata().map_err(unreadable)?.len();
        Ok(Self { file, bytes, name: dataset.to_owned() })
    }

    /// The archive from its byte `from` on.
    pub(super) fn at(&self, from: u64) -> Result<File, CliError> {
        let unreadable = |error| CliError::unreadable(&self.name, &error);
        let mut file = self.file.try_clone().map_err(unreadable)?;
        file.seek(SeekFrom::Start(from)).map_err(unreadable)?;
        Ok(file)
    }

    /// At most `bytes` bytes from `from` on.
    pub(super) fn part(&self, from: u64, bytes: u64) -> Result<Vec<u8>, CliError> {
        let mut part = Vec::new();
        let read = self.at(from)?.take(bytes).read_to_end(&mut part);
        read.map_err(|error| CliError::unreadable(&self.name, &error))?;
        Ok(part)
    }
}
