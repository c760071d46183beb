//! Writes of long objects in parts: readers see nothing of an object before its last part is there.

use object_store::{ObjectStore, ObjectStoreExt as _, WriteMultipart, path::Path as ObjectPath};
use tokio::io::{AsyncRead, AsyncReadExt as _};

use super::BlobError;

/// The length of the parts of all but the longest objects.
pub(super) const PART_BYTES: usize = 8 << 20;
/// The most parts of an object that S3 takes.
const MAX_PARTS: u64 = 10_000;
const PARTS_IN_FLIGHT: usize = 2;
const READ_BYTES: usize = 1 << 20;

/// The length of the parts of an object of `length` bytes.
fn part_bytes(length: u64) -> usize {
    usize::try_from(length.div_ceil(MAX_PARTS)).unwrap_or(usize::MAX).max(PART_BYTES)
}

/// Writes `content`, which has `length` bytes, as one object. If that fails, the parts already written are given up.
///
/// # Errors
/// [`BlobError::Io`] if the content cannot be read; what `failed` makes of an error of the object store.
pub(super) async fn write_parts(
    store: &dyn ObjectStore,
    to: &ObjectPath,
    content: impl AsyncRead + Unpin + Send,
    length: u64,
    failed: fn(object_store::Error) -> BlobError,
) -> Result<(), BlobError> {
    let upload = store.put_multipart(to).await.map_err(failed)?;
    let mut writer = WriteMultipart::new_with_chunk_size(upload, part_bytes(length));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_objects_have_no_more_parts_than_a_bucket_takes() {
        for length in [0, 1, 8 << 20, 10_000 * (8 << 20), 10_000 * (8 << 20) + 1, 100 << 30, (5 << 40) - 1] {
            let part = part_bytes(length) as u64;
            assert!(length.div_ceil(part) <= MAX_PARTS && part >= PART_BYTES as u64, "{length}: {part}");
            assert!(part <= 5 << 30, "a part has at most 5 GiB");
        }
        assert_eq!(part_bytes(10_000 * (8 << 20)), PART_BYTES);
    }
}
