//! Files that never change, whole or in part, with a digest of the whole (RFC 9110 §13, §14; RFC 9530).

use axum::{
    body::Body,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};

use super::{
    etag::{Etag, not_modified},
    problem::Fault,
    range::{Wanted, wanted},
    state::AppState,
};
use crate::{
    domain::{Digest, JobId},
    store::{ArtifactKind, BlobRef, FileRecord},
};

/// A file as clients get it.
#[derive(Debug)]
pub(super) struct File {
    pub(super) blob: BlobRef,
    pub(super) media_type: &'static str,
    /// The name to save it by: plain ASCII.
    pub(super) name: String,
}

impl File {
    /// A file of a job.
    pub(super) fn new(job: JobId, kind: ArtifactKind, lambda: Option<f64>, blob: BlobRef) -> Self {
        let point = lambda.map_or_else(String::new, |lambda| format!(".lambda-{lambda}"));
        let name = match kind {
            ArtifactKind::Scene(format) => format!("{job}{point}.{}", format.extension()),
            _ => format!("{job}.{}.json", kind.name()),
        };
        Self { blob, media_type: media_type(kind), name }
    }
}

impl From<FileRecord> for File {
    fn from(FileRecord { job, kind, lambda, blob }: FileRecord) -> Self {
        Self::new(job, kind, lambda, blob)
    }
}

/// The media type of a kind of file.
pub(super) fn media_type(kind: ArtifactKind) -> &'static str {
    match kind {
        ArtifactKind::Scene(format) => format.media_type(),
        _ => "application/json",
    }
}

/// Answers `GET` and `HEAD` of a file.
pub(super) async fn serve(state: &AppState, request: &HeaderMap, file: File) -> Result<Response, Fault> {
    let File { blob, media_type, name } = file;
    let etag = Etag::new(blob.digest);
    if etag.wanted_by_if_match(request).is_none() {
        return Err(Fault::new(
            StatusCode::PRECONDITION_FAILED,
            "precondition-failed",
            "Precondition failed",
            "the file is another than If-Match says",
        ));
    }
    if etag.is_in_if_none_match(request) {
        return Ok(not_modified(&etag));
    }
    let range = request.get(header::RANGE).filter(|_| etag.allows_range(request));
    let (status, part) = match wanted(range.and_then(|value| value.to_str().ok()), blob.bytes) {
        Wanted::Whole => (StatusCode::OK, 0..blob.bytes),
        Wanted::Part(part) => (StatusCode::PARTIAL_CONTENT, part),
        Wanted::Unsatisfiable => return Err(unsatisfiable(blob.bytes)),
    };
    let body = if part.is_empty() {
        Body::empty()
    } else {
        Body::from_stream(state.blobs().stream(blob.digest, part.clone()).await?)
    };
    let mut response = (status, body).into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(header::CONTENT_LENGTH, HeaderValue::from(part.end - part.start));
    headers.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    headers.insert(header::ETAG, etag.value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, max-age=31536000, immutable"));
    let mut text = |name: &'static str, value: String| {
        HeaderValue::try_from(value).map(|value| headers.insert(name, value))
    };
    let named = text("content-disposition", format!("attachment; filename=\"{name}\""))
        .and(text("repr-digest", format!("sha-256=:{}:", base64(&blob.digest))));
    named.map_err(|error| Fault::internal(&error))?;
    if status == StatusCode::PARTIAL_CONTENT {
        let value = format!("bytes {}-{}/{}", part.start, part.end - 1, blob.bytes);
        headers.insert(
            header::CONTENT_RANGE,
            HeaderValue::try_from(value).map_err(|error| Fault::internal(&error))?,
        );
    }
    Ok(response)
}

fn unsatisfiable(length: u64) -> Fault {
    let fault = Fault::new(
        StatusCode::RANGE_NOT_SATISFIABLE,
        "range-not-satisfiable",
        "Range not satisfiable",
        format!("the file has {length} bytes"),
    );
    match HeaderValue::try_from(format!("bytes */{length}")) {
        Ok(value) => fault.with(header::CONTENT_RANGE, value),
        Err(_) => fault,
    }
}

/// RFC 4648 base64 with padding, as structured headers carry bytes.
fn base64(digest: &Digest) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(44);
    for chunk in digest.as_bytes().chunks(3) {
        let word =
            chunk.iter().enumerate().fold(0_u32, |word, (at, &b)| word | u32::from(b) << (16 - 8 * at));
        for position in 0..4 {
            if position <= chunk.len() {
                text.push(char::from(ALPHABET[(word >> (18 - 6 * position)) as usize & 63]));
            } else {
                text.push('=');
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digests_are_written_in_base64() {
        assert_eq!(base64(&Digest::of(b"abc")), "ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=");
        assert_eq!(base64(&Digest::of(b"")), "47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=");
    }
}
