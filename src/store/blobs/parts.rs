//! Writes of long objects in parts: readers see nothing of an object before its last part is there.

use object_store::{ObjectStore, ObjectStoreExt as _, WriteMultipart, path::Path as ObjectPath};
use tokio::io::{AsyncRead, AsyncReadExt as _};

use super::BlobError;

/// The length of parts. S3 has at most 10 000 parts, so content of up to 80 GB.
pub(super) const PART_BYTES: usize = 8 << 20;
const PARTS_IN_FLIGHT: usize = 2;
const READ_BYTES: usize = 1 << 20;

/// Writes `content` as one object. If that fails, the parts already written are given up.
///
/// # Errors
/// [`BlobError::Io`] if the content cannot be read; what `failed` makes of an error of the object store.
pub(super) async fn write_parts(
    store: &dyn ObjectStore,
    to: &ObjectPath,
    content: impl AsyncRead + Unpin + Send,
    failed: fn(object_store::Error) -> BlobError,
) -> Result<(), BlobError> {
    let upload = store.put_multipart(to).await.map_err(failed)?;
    let mut writer = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
    if let Err(error) = copy(content, &mut writer, failed).await {
        // The copy's own error is the one to report.
        let _ = writer.abort().await;
        return Err(error);
    }
    writer.finish().await.map(drop).map_err(failed)
}

async fn copy(
    mut content: impl AsyncRead + Unpin + Send,
    writer: &mut WriteMultipart,
    failed: fn(object_store::Error) -> BlobError,
) -> Result<(), BlobError> {
    let mut buffer = vec![0; READ_BYTES];
    loop {
        let count = content.read(&mut buffer).await?;
        if count == 0 {
            return Ok(());
        }
        writer.wait_for_capacity(PARTS_IN_FLIGHT).await.map_err(failed)?;
        writer.write(&buffer[..count]);
    }
}
