//! Files that change, kept in a bucket so that other machines can go on with them.
//!
//! A file is replaced whole. Who may write which is for their users to order: names here are not shared by two writers.

use std::{path::Path, sync::Arc};

use bytes::Bytes;
use futures_util::{StreamExt as _, TryStreamExt as _, stream::BoxStream};
use object_store::{ObjectStore, ObjectStoreExt as _, path::Path as ObjectPath};
use tokio::{
    fs::File,
    io::{AsyncReadExt as _, AsyncWriteExt as _},
};

use super::{BlobError, PART_BYTES, write_parts};

/// Changing files in a bucket, by names with `/`.
#[derive(Debug, Clone)]
pub struct SharedFiles(pub(super) Arc<dyn ObjectStore>);

impl SharedFiles {
    /// The names of all files below `folder`, in order.
    ///
    /// # Errors
    /// [`BlobError::Bucket`].
    pub async fn below(&self, folder: &str) -> Result<Vec<String>, BlobError> {
        let listed = self.0.list(Some(&ObjectPath::from(folder)));
        let mut names: Vec<String> = listed
            .map_ok(|object| object.location.to_string())
            .try_collect()
            .await
            .map_err(BlobError::Bucket)?;
        names.sort();
        Ok(names)
    }

    /// The names of the folders directly in `folder`, without the names of what they are in.
    ///
    /// # Errors
    /// [`BlobError::Bucket`].
    pub async fn folders(&self, folder: &str) -> Result<Vec<String>, BlobError> {
        let listed = self.0.list_with_delimiter(Some(&ObjectPath::from(folder))).await;
        let folders = listed.map_err(BlobError::Bucket)?.common_prefixes;
        Ok(folders.iter().filter_map(|path| Some(path.filename()?.to_owned())).collect())
    }

    /// Saves the content that a file has now.
    ///
    /// # Errors
    /// [`BlobError::Io`], [`BlobError::Bucket`].
    pub async fn save(&self, name: &str, from: &Path) -> Result<(), BlobError> {
        let mut file = File::open(from).await?;
        let name = ObjectPath::from(name);
        let length = file.metadata().await?.len();
        if length <= PART_BYTES as u64 {
            let mut content = Vec::new();
            file.read_to_end(&mut content).await?;
            return self.0.put(&name, content.into()).await.map(drop).map_err(BlobError::Bucket);
        }
        write_parts(&*self.0, &name, file, length, BlobError::Bucket).await
    }

    /// Loads a file into a new one; folders that it lacks are made.
    ///
    /// # Errors
    /// [`BlobError::Io`], [`BlobError::Bucket`].
    pub async fn load(&self, name: &str, to: &Path) -> Result<(), BlobError> {
        if let Some(folder) = to.parent() {
            tokio::fs::create_dir_all(folder).await?;
        }
        let mut file = File::create(to).await?;
        let mut content = self.content(name).await?;
        while let Some(piece) = content.try_next().await? {
            file.write_all(&piece).await?;
        }
        Ok(file.flush().await?)
    }

    /// A file's content.
    pub(super) async fn content(
        &self,
        name: &str,
    ) -> Result<BoxStream<'static, Result<Bytes, BlobError>>, BlobError> {
        let found = self.0.get(&ObjectPath::from(name)).await.map_err(BlobError::Bucket)?;
        Ok(found.into_stream().map_err(BlobError::Bucket).boxed())
    }

    /// Removes every file below `folder`.
    ///
    /// # Errors
    /// [`BlobError::Bucket`].
    pub async fn remove_below(&self, folder: &str) -> Result<(), BlobError> {
        for name in self.below(folder).await? {
            match self.0.delete(&ObjectPath::from(name)).await {
                Ok(()) | Err(object_store::Error::NotFound { .. }) => {}
                Err(error) => return Err(BlobError::Bucket(error)),
            }
        }
        Ok(())
    }
}
