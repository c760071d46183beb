//! Backups of a data folder while its service runs, and their restoration.
//!
//! A backup is a snapshot of the database and the files that it refers to. Files never change, so only their removal could disagree with
//! the snapshot: then a newer one is taken. Open uploads, checkpoints and unreferenced files are left out. A backup is complete once it has
//! its [`NOTE`], and a restored folder once it has its database; both are written last.

use std::{
    fs::{self, File},
    io::{self, Write as _},
    path::{Path, PathBuf},
    sync::Arc,
};

use jiff::Timestamp;
use object_store::ObjectStore;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{
    BlobError, BlobPlace, BlobSource, BlobState, Blobs, CopyMode, QueuePolicy, Store, StoreError, fsck::BATCH,
};
use crate::domain::{Clock, Digest};

/// Name of the database in a data folder and in a backup.
pub const DATABASE: &str = "tcgs.sqlite";

/// Name of the file that says that a backup is complete, and of what.
const NOTE: &str = "backup.json";

/// Most snapshots that are taken because files of the one before were removed meanwhile.
const SNAPSHOTS: usize = 5;

/// A complete backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BackupNote {
    /// When its snapshot was taken.
    pub taken_at: Timestamp,
    /// The program's version.
    pub version: String,
    /// Files that the database refers to.
    pub blobs: u64,
    pub bytes: u64,
}

/// Why a backup or a restoration failed.
#[derive(Debug, Error)]
pub enum BackupError {
    /// There is something in the folder already.
    #[error("{0} is not empty; name a folder that is absent or empty")]
    NotEmpty(PathBuf),
    /// The folder is no complete backup.
    #[error("{0} is not a complete backup: it has no readable {NOTE}")]
    Incomplete(PathBuf),
    /// A file that the database refers to is not there.
    #[error("the file {digest} is missing in {source_name}; 'tcgs fsck' finds all such files")]
    Missing {
        /// Its name.
        digest: Digest,
        /// Where it should be.
        source_name: String,
    },
    /// A file that the database refers to has other content.
    #[error("the file {digest} in {source_name} is damaged; 'tcgs fsck' finds all such files")]
    Damaged {
        /// Its name.
        digest: Digest,
        /// Where it is.
        source_name: String,
    },
    /// The bucket to restore into is another database's.
    #[error(
        "the bucket belongs to another database, perhaps the one that was backed up; name another bucket, or another prefix: \
         s3://BUCKET/PREFIX; if no service uses that database any more, or an earlier restoration into this bucket failed, \
         repeat with --take-over-bucket"
    )]
    BucketInUse,
    /// The database failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The file system failed.
    #[error(transparent)]
    Blobs(#[from] BlobError),
}

impl From<io::Error> for BackupError {
    fn from(error: io::Error) -> Self {
        Self::Blobs(error.into())
    }
}

/// Refuses a folder with anything in it, and creates an absent one.
fn require_empty(folder: &Path) -> Result<(), BackupError> {
    fs::create_dir_all(folder)?;
    if fs::read_dir(folder)?.next().is_some() {
        return Err(BackupError::NotEmpty(folder.to_owned()));
    }
    Ok(())
}

fn sync(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

/// Writes a backup of the store, whose blobs are in `source`, into `destination`.
///
/// # Errors
/// [`BackupError`]; the destination is then no backup, and can be deleted.
pub async fn back_up(
    store: &Store,
    source: &BlobSource,
    destination: &Path,
    mode: CopyMode,
    clock: Arc<dyn Clock>,
) -> Result<BackupNote, BackupError> {
    require_empty(destination)?;
    let copy = Blobs::open(destination)?;
    let database = destination.join(DATABASE);
    let mut snapshots = 0;
    loop {
        snapshots += 1;
        let taken_at = clock.now();
        remove_database(&database)?;
        store.copy_into(&database).await?;
        let snapshot = Store::open_current(&database, clock.clone(), QueuePolicy::default()).await?;
        let copied = copy_blobs(&snapshot, source, &copy, mode).await;
        snapshot.close().await;
        if let Err(BackupError::Missing { digest, .. }) = &copied {
            // What referred to it may have been deleted since the snapshot.
            let is_deleted = !store.without_references(&[*digest]).await?.is_empty();
            if is_deleted && snapshots < SNAPSHOTS {
                continue;
            }
        }
        let (blobs, bytes) = copied?;
        tidy(destination)?;
        sync(&database)?;
        let note = BackupNote { taken_at, version: env!("CARGO_PKG_VERSION").to_owned(), blobs, bytes };
        write_note(destination, &note)?;
        return Ok(note);
    }
}

/// Copies what a snapshot refers to, and counts it; forgets in the snapshot what nothing refers to, and ends its open uploads.
async fn copy_blobs(
    snapshot: &Store,
    source: &BlobSource,
    copy: &Blobs,
    mode: CopyMode,
) -> Result<(u64, u64), BackupError> {
    snapshot.end_uploads().await?;
    let (mut blobs, mut bytes, mut after) = (0, 0, None);
    loop {
        let batch = snapshot.blob_rows(after, BATCH).await?;
        let Some(last) = batch.last() else { return Ok((blobs, bytes)) };
        after = Some(last.digest);
        let digests: Vec<Digest> = batch.iter().map(|blob| blob.digest).collect();
        let unused = snapshot.forget_blobs(&digests).await?;
        for blob in batch.into_iter().filter(|blob| !unused.contains(&blob.digest)) {
            let (digest, source_name) = (blob.digest, source.to_string());
            match copy.copy_from(source, blob, mode).await? {
                BlobState::Sound => {}
                BlobState::Missing => return Err(BackupError::Missing { digest, source_name }),
                BlobState::Damaged => return Err(BackupError::Damaged { digest, source_name }),
            }
            blobs += 1;
            bytes += blob.bytes;
        }
    }
}

/// Which buckets a backup may be restored into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BucketClaim {
    /// One that no database has.
    Unclaimed,
    /// Any; a database that has it loses it.
    TakeOver,
}

/// Restores a backup into a data folder that is absent or empty. Every file is copied, and checked against its digest. The schema of an
/// earlier version is brought up to date in the copy; the backup is only read. The restored database is another one than the one that was
/// backed up, whose bucket it is refused unless it takes it over.
///
/// # Errors
/// [`BackupError`]; the folder then has no database, and can be deleted.
pub async fn restore(
    backup: &Path,
    data: &Path,
    bucket: Option<(Arc<dyn ObjectStore>, BucketClaim)>,
    clock: Arc<dyn Clock>,
) -> Result<BackupNote, BackupError> {
    let incomplete = || BackupError::Incomplete(backup.to_owned());
    let note = fs::read(backup.join(NOTE)).map_err(|_| incomplete())?;
    let note: BackupNote = serde_json::from_slice(&note).map_err(|_| incomplete())?;
    require_empty(data)?;
    let staged = data.join(format!("{DATABASE}.restoring"));
    fs::copy(backup.join(DATABASE), &staged)?;
    let copied = async {
        let store = Store::open(&staged, clock, QueuePolicy::default()).await?;
        let copy = match bucket {
            None => {
                store.move_blobs(BlobPlace::Folder).await?;
                Blobs::open(data)?
            }
            Some((bucket, claim)) => {
                store.move_blobs(BlobPlace::Bucket).await?;
                open_bucket(data, bucket, claim, &store).await?
            }
        };
        let source = BlobSource::Folder(backup.to_owned());
        let copied = copy_blobs(&store, &source, &copy, CopyMode::Content).await;
        store.close().await;
        copied
    };
    let found = copied.await?;
    if found != (note.blobs, note.bytes) {
        return Err(incomplete());
    }
    sync(&staged)?;
    fs::rename(&staged, data.join(DATABASE))?;
    for suffix in ["-wal", "-shm", ".lock"] {
        remove_if_there(&data.join(format!("{DATABASE}.restoring{suffix}")))?;
    }
    sync(data)?;
    Ok(note)
}

async fn open_bucket(
    data: &Path,
    bucket: Arc<dyn ObjectStore>,
    claim: BucketClaim,
    store: &Store,
) -> Result<Blobs, BackupError> {
    let opened = match claim {
        BucketClaim::Unclaimed => Blobs::open_bucket(data, bucket, store.clone()).await,
        BucketClaim::TakeOver => Blobs::take_over_bucket(data, bucket, store.clone()).await,
    };
    opened.map_err(|error| match error {
        BlobError::OtherDatabase => BackupError::BucketInUse,
        error => error.into(),
    })
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

fn remove_database(path: &Path) -> io::Result<()> {
    for suffix in ["", "-wal", "-shm"] {
        let mut name = path.as_os_str().to_owned();
        name.push(suffix);
        remove_if_there(Path::new(&name))?;
    }
    Ok(())
}

/// Removes what working on the copy left.
fn tidy(destination: &Path) -> io::Result<()> {
    for suffix in ["-wal", "-shm", ".lock"] {
        remove_if_there(&destination.join(format!("{DATABASE}{suffix}")))?;
    }
    Ok(())
}

fn write_note(destination: &Path, note: &BackupNote) -> io::Result<()> {
    let staged = destination.join(format!("{NOTE}.new"));
    let mut file = File::create(&staged)?;
    file.write_all(&serde_json::to_vec_pretty(note)?)?;
    file.sync_all()?;
    fs::rename(&staged, destination.join(NOTE))?;
    sync(destination)
}
