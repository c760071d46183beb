//! Backups, restorations and checks of data folders.

use std::{path::Path, sync::Arc};

use tcgs::{
    domain::{Clock as _, Problem, ProblemType, SystemClock},
    store::{
        BackupError, BackupNote, BlobError, BlobSource, BucketClaim, BucketUrl, CheckDepth, CopyMode,
        FsckReport, QueuePolicy, Store, back_up as write_backup, check_data_folder, garbage::GarbageError,
        restore as restore_backup,
    },
};

use super::{
    private,
    runtime::{runtime, unavailable},
    service::open_blobs,
};
use crate::cli::{CliError, storage::Storage};

/// The store of a service, which must be there.
async fn existing(storage: &Storage) -> Result<Store, CliError> {
    storage.expect_database()?;
    let store = Store::open_current(storage.location(), Arc::new(SystemClock), QueuePolicy::default()).await;
    store.map_err(|error| unavailable(&error))
}

/// Writes a backup of a data folder, whether its service runs or not.
pub(crate) fn back_up(storage: &Storage, destination: &Path, mode: CopyMode) -> Result<BackupNote, CliError> {
    runtime()?.block_on(async {
        let store = existing(storage).await?;
        private::create(destination).map_err(|error| CliError::unwritable(destination, &error))?;
        let source = match storage.blobs {
            Some(_) => BlobSource::Store(open_blobs(storage, &store).await?),
            // Only read, so that a backup can be made of a full disk.
            None => BlobSource::Folder(storage.data.clone()),
        };
        let note = write_backup(&store, &source, destination, mode, Arc::new(SystemClock)).await;
        store.close().await;
        note.map_err(failed)
    })
}

/// Restores a backup.
pub(crate) fn restore(backup: &Path, storage: &Storage, claim: BucketClaim) -> Result<BackupNote, CliError> {
    let data = &storage.data;
    runtime()?.block_on(async {
        private::create(data).map_err(|error| CliError::unwritable(data, &error))?;
        let bucket = storage.blobs.as_ref().map(BucketUrl::connect).transpose();
        let bucket = bucket.map_err(|error| unavailable(&error))?.map(|bucket| (bucket, claim));
        restore_backup(backup, data, bucket, Arc::new(SystemClock)).await.map_err(failed)
    })
}

/// Checks a data folder, whether its service runs or not.
pub(crate) fn fsck(storage: &Storage, depth: CheckDepth) -> Result<FsckReport, CliError> {
    runtime()?.block_on(async {
        let store = existing(storage).await?;
        let blobs = open_blobs(storage, &store).await?;
        let report = check_data_folder(&store, &blobs, depth, SystemClock.now()).await;
        store.close().await;
        report.map_err(|error| match error {
            GarbageError::Store(error) => unavailable(&error),
            GarbageError::Blobs(error) => of_files(error),
        })
    })
}

fn failed(error: BackupError) -> CliError {
    let kind = match error {
        BackupError::NotEmpty(_) | BackupError::BucketInUse => ProblemType::Exists,
        BackupError::Incomplete(_) => ProblemType::UnreadableInput,
        BackupError::Missing { .. } | BackupError::Damaged { .. } => ProblemType::DataDamaged,
        BackupError::Store(error) => return unavailable(&error),
        BackupError::Blobs(error) => return of_files(error),
    };
    Problem::new(kind, error.to_string()).into()
}

fn of_files(error: BlobError) -> CliError {
    if error.is_disk_full() {
        return Problem::new(ProblemType::UnwritableOutput, "the disk is full").into();
    }
    unavailable(&error)
}
