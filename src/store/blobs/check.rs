//! Compares blobs with their names, and copies them from other data folders.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use tokio::{fs::File, io::AsyncReadExt as _};

use super::{BlobError, Blobs, ContentHasher, blocking, files::sync_folder, location};
use crate::{domain::Digest, store::BlobRef};

/// Bytes read at a time.
const PIECE: usize = 1 << 20;

/// How closely blobs are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CheckDepth {
    /// Their lengths.
    Length,
    /// Their lengths and digests.
    Content,
}

/// What a blob's file was found to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlobState {
    /// As its name says.
    Sound,
    /// Not there.
    Missing,
    /// Of another length or content.
    Damaged,
}

/// How blobs are copied.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CopyMode {
    /// By a second name for the same file where the file systems allow it, else by content.
    Link,
    /// By content.
    Content,
}

/// Where a data folder has a blob.
fn place(data: &Path, digest: Digest) -> PathBuf {
    data.join("blobs").join(location(digest).to_string())
}

/// The file; `None` if there is none.
async fn open(path: &Path) -> Result<Option<File>, BlobError> {
    match File::open(path).await {
        Ok(file) => Ok(Some(file)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}

async fn check_file(path: &Path, blob: BlobRef, depth: CheckDepth) -> Result<BlobState, BlobError> {
    let Some(mut file) = open(path).await? else { return Ok(BlobState::Missing) };
    if file.metadata().await?.len() != blob.bytes {
        return Ok(BlobState::Damaged);
    }
    if depth == CheckDepth::Length {
        return Ok(BlobState::Sound);
    }
    let mut content = ContentHasher::new(u64::MAX);
    let mut buffer = vec![0; PIECE];
    loop {
        match file.read(&mut buffer).await? {
            0 => break,
            count => content.update(&buffer[..count])?,
        }
    }
    Ok(if content.finish() == blob { BlobState::Sound } else { BlobState::Damaged })
}

impl Blobs {
    /// Compares a blob's file with its name and length.
    ///
    /// # Errors
    /// [`BlobError`] if the file cannot be read for another reason than its absence.
    pub async fn check(&self, blob: BlobRef, depth: CheckDepth) -> Result<BlobState, BlobError> {
        check_file(&self.0.store.path_to_filesystem(&location(blob.digest))?, blob, depth).await
    }

    /// Copies a blob from another data folder, which is only read, unless it is here; a copy by content is checked against its digest.
    /// Returns what was found: nothing is copied of a blob that is missing or damaged there.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn copy_from(
        &self,
        source: &Path,
        blob: BlobRef,
        mode: CopyMode,
    ) -> Result<BlobState, BlobError> {
        if self.check(blob, CheckDepth::Length).await? == BlobState::Sound {
            return Ok(BlobState::Sound);
        }
        let from = place(source, blob.digest);
        if mode == CopyMode::Link {
            match check_file(&from, blob, CheckDepth::Length).await? {
                BlobState::Sound => {}
                fault => return Ok(fault),
            }
            if self.link_from(from.clone(), blob.digest).await? {
                return Ok(BlobState::Sound);
            }
        }
        let Some(mut file) = open(&from).await? else { return Ok(BlobState::Missing) };
        let mut staged = self.stage(blob.bytes).await?;
        let mut buffer = vec![0; PIECE];
        loop {
            match file.read(&mut buffer).await? {
                0 => break,
                count => match staged.write(&buffer[..count]).await {
                    Err(BlobError::TooLarge { .. }) => return Ok(BlobState::Damaged),
                    written => written?,
                },
            }
        }
        let staged = staged.finish().await?;
        if staged.blob() != blob {
            return Ok(BlobState::Damaged);
        }
        self.publish(&staged).await?;
        Ok(BlobState::Sound)
    }

    /// Gives a file the name of a blob here too, and returns whether that was possible.
    async fn link_from(&self, from: PathBuf, digest: Digest) -> Result<bool, BlobError> {
        let to = self.0.store.path_to_filesystem(&location(digest))?;
        let root = self.0.root.clone();
        blocking(move || {
            let Some(folder) = to.parent() else { return Ok(false) };
            fs::create_dir_all(folder)?;
            if fs::hard_link(&from, &to).is_err() {
                // Another file system, one without links, or a file that is gone; copying finds out which.
                return Ok(false);
            }
            for folder in folder.ancestors().take_while(|folder| folder.starts_with(&root)) {
                sync_folder(folder)?;
            }
            Ok(true)
        })
        .await
    }
}
