//! A whole blob as a stream that ends with an error, before its end, if the content is not what its name says.

use std::mem;

use bytes::Bytes;
use futures_util::{StreamExt as _, TryStreamExt as _, stream};

use super::{BlobError, ContentHasher, Pieces};
use crate::store::BlobRef;

/// Passes the content on, one piece late: the last one goes out once the digest of all is right. So whoever receives a damaged blob receives
/// less than its length.
pub(super) fn verified(blob: BlobRef, content: Pieces) -> Pieces {
    let begin = Some(Reader { content, hasher: ContentHasher::new(u64::MAX), held: Bytes::new() });
    let pieces = stream::try_unfold(begin, move |reader| async move {
        let Some(mut reader) = reader else { return Ok(None) };
        match reader.next(blob).await? {
            Some(piece) => Ok(Some((piece, Some(reader)))),
            None => Ok(Some((reader.finish(blob)?, None))),
        }
    });
    let report = move |error: &BlobError| {
        let error = error as &dyn std::error::Error;
        tracing::error!(blob = %blob.digest, error, "reading of blob {} is cut off: {error}", blob.digest);
    };
    pieces.inspect_err(report).boxed()
}

struct Reader {
    content: Pieces,
    hasher: ContentHasher,
    /// The latest piece.
    held: Bytes,
}

impl Reader {
    /// The piece before the latest; `None` at the end of the content, and once it is longer than the blob.
    async fn next(&mut self, blob: BlobRef) -> Result<Option<Bytes>, BlobError> {
        while let Some(piece) = self.content.try_next().await? {
            self.hasher.update(&piece)?;
            if self.hasher.bytes() > blob.bytes {
                break;
            }
            let ready = mem::replace(&mut self.held, piece);
            if !ready.is_empty() {
                return Ok(Some(ready));
            }
        }
        Ok(None)
    }

    /// The last piece, if what was read is the blob.
    fn finish(self, blob: BlobRef) -> Result<Bytes, BlobError> {
        let actual = self.hasher.finish();
        if actual == blob {
            Ok(self.held)
        } else {
            Err(BlobError::Damaged { expected: blob.digest, actual: actual.digest })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Digest;

    async fn read(pieces: &[&'static str], blob: BlobRef) -> (String, Option<BlobError>) {
        let content = stream::iter(
            pieces.iter().map(|piece| Ok(Bytes::from_static(piece.as_bytes()))).collect::<Vec<_>>(),
        );
        let mut stream = verified(blob, content.boxed());
        let mut read = String::new();
        loop {
            match stream.try_next().await {
                Ok(Some(piece)) => read += std::str::from_utf8(&piece).expect("text"),
                Ok(None) => return (read, None),
                Err(error) => return (read, Some(error)),
            }
        }
    }

    #[tokio::test]
    async fn a_sound_blob_passes_and_a_damaged_one_ends_before_its_end() {
        let blob = |text: &str| BlobRef { digest: Digest::of(text.as_bytes()), bytes: text.len() as u64 };
        for pieces in [&["whole"][..], &["wh", "ole"], &["", "whole", ""], &["w", "h", "o", "l", "e"]] {
            let (content, error) = read(pieces, blob("whole")).await;
            assert!(content == "whole" && error.is_none(), "{pieces:?}: {content} {error:?}");
        }
        for pieces in [
            &["whale"][..],
            &["wh", "ale"],
            &["who"],
            &["who", "l"],
            &[],
            &["whole", "r"],
            &["who", "le", "r"],
        ] {
            let (content, error) = read(pieces, blob("whole")).await;
            assert!(content.len() < 5, "{pieces:?}: {content}");
            assert!(
                matches!(error, Some(BlobError::Damaged { .. } | BlobError::TooLarge { .. })),
                "{error:?}"
            );
        }
        assert!(matches!(read(&[], blob("")).await, (content, None) if content.is_empty()));
    }
}
