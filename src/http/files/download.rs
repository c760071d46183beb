//! Serves immutable files, whole or a range, with the digest of the whole (RFC 9110 §13, §14; RFC 9530). A whole file that does not have that
//! digest is cut off before its end.

use std::{convert::Infallible, ops::Range};

use axum::{
    body::Body,
    http::{HeaderMap, HeaderValue, Method, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use base64::{Engine as _, engine::general_purpose::STANDARD};
use bytes::Bytes;
use futures_util::{Stream, stream};

use crate::{
    domain::{Digest, JobId, ProblemType},
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::{ByteRange, Etag, IfMatch, not_modified, parse_range},
        state::AppState,
    },
    store::{ArtifactKind, BlobRef, FileRecord},
};

/// Bytes of a piece of a file in memory.
const PIECE: usize = 64 << 10;

/// A downloadable file.
#[derive(Debug)]
pub(crate) struct File {
    pub(crate) blob: BlobRef,
    pub(crate) media_type: &'static str,
    /// The name to save it by: plain ASCII.
    pub(crate) name: String,
}

impl File {
    /// A file of a job.
    pub(crate) fn new(job: JobId, kind: ArtifactKind, lambda: Option<f64>, blob: BlobRef) -> Self {
        let point = lambda.map_or_else(String::new, |lambda| format!(".lambda-{lambda}"));
        let name = match kind {
            ArtifactKind::Scene(format) => format!("{job}{point}.{}", format.extension()),
            ArtifactKind::SparseModel => format!("{job}.{}.zip", kind.name()),
            ArtifactKind::Thumbnail | ArtifactKind::Preview | ArtifactKind::PreviewPhotograph => {
                format!("{job}.{}.jpg", kind.name())
            }
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
pub(crate) fn media_type(kind: ArtifactKind) -> &'static str {
    match kind {
        ArtifactKind::Scene(format) => format.media_type(),
        ArtifactKind::SparseModel => "application/zip",
        ArtifactKind::Thumbnail | ArtifactKind::Preview | ArtifactKind::PreviewPhotograph => "image/jpeg",
        _ => "application/json",
    }
}

/// A file that is made for one answer, and what is kept until its last byte is sent.
pub(crate) struct MadeFile<K> {
    pub(crate) bytes: Bytes,
    pub(crate) digest: Digest,
    pub(crate) media_type: &'static str,
    pub(crate) name: String,
    pub(crate) kept: K,
}

/// Answers as [`serve`] does, with a file that is not among the blobs.
pub(crate) fn serve_made<K: Send + 'static>(
    method: &Method,
    request: &HeaderMap,
    made: MadeFile<K>,
) -> ApiResult {
    let MadeFile { bytes, digest, media_type, name, kept } = made;
    let blob = BlobRef { digest, bytes: bytes.len() as u64 };
    match answer(method, request, blob)? {
        Answer::NotModified(response) => Ok(response),
        Answer::Part { status, part, has_body } => {
            let part_bytes = bytes.slice(part.start as usize..part.end as usize);
            let body = if has_body { Body::from_stream(in_pieces(part_bytes, kept)) } else { Body::empty() };
            respond((status, body), File { blob, media_type, name }, part)
        }
    }
}

/// The bytes in pieces; `kept` is dropped with the last of them.
pub(crate) fn in_pieces<K>(bytes: Bytes, kept: K) -> impl Stream<Item = Result<Bytes, Infallible>> {
    stream::unfold((bytes, kept), async |(mut bytes, kept)| {
        let length = bytes.len().min(PIECE);
        (length > 0).then(|| (Ok(bytes.split_to(length)), (bytes, kept)))
    })
}

/// What a request gets of a file.
enum Answer {
    NotModified(Response),
    Part { status: StatusCode, part: Range<u64>, has_body: bool },
}

fn answer(method: &Method, request: &HeaderMap, blob: BlobRef) -> ApiResult<Answer> {
    let etag = Etag::new(blob.digest);
    if etag.if_match(request) == IfMatch::Differs {
        return Err(ProblemType::PreconditionFailed.because("the file is not the one that If-Match names"));
    }
    if etag.is_in_if_none_match(request) {
        return Ok(Answer::NotModified(not_modified(&etag)));
    }
    let is_head = *method == Method::HEAD;
    let range = request.get(header::RANGE).filter(|_| !is_head && etag.allows_range(request));
    let (status, part) = match parse_range(range.and_then(|value| value.to_str().ok()), blob.bytes) {
        ByteRange::Whole => (StatusCode::OK, 0..blob.bytes),
        ByteRange::Part(part) => (StatusCode::PARTIAL_CONTENT, part),
        ByteRange::Unsatisfiable => return Err(unsatisfiable(blob.bytes)),
    };
    let has_body = !is_head && !part.is_empty();
    Ok(Answer::Part { status, part, has_body })
}

/// Answers `GET` and `HEAD` of a file. `HEAD` is about the whole file, since ranges are defined for `GET` alone, and does not open it.
pub(crate) async fn serve(state: &AppState, method: &Method, request: &HeaderMap, file: File) -> ApiResult {
    let blob = file.blob;
    let (status, part, has_body) = match answer(method, request, blob)? {
        Answer::NotModified(response) => return Ok(response),
        Answer::Part { status, part, has_body } => (status, part, has_body),
    };
    let body = if !has_body {
        Body::empty()
    } else if part == (0..blob.bytes) {
        Body::from_stream(state.blobs().stream_whole(blob).await?)
    } else {
        Body::from_stream(state.blobs().stream_part(blob.digest, part.clone()).await?)
    };
    respond((status, body), file, part)
}

fn respond((status, body): (StatusCode, Body), file: File, part: Range<u64>) -> ApiResult {
    let File { blob, media_type, name } = file;
    let mut response = (status, body).into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(header::CONTENT_LENGTH, HeaderValue::from(part.end - part.start));
    headers.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    headers.insert(header::ETAG, Etag::new(blob.digest).value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, max-age=31536000, immutable"));
    let mut text = |name: &'static str, value: String| {
        HeaderValue::try_from(value).map(|value| headers.insert(name, value))
    };
    let named = text("content-disposition", format!("attachment; filename=\"{name}\""))
        .and(text("repr-digest", format!("sha-256=:{}:", STANDARD.encode(blob.digest.as_bytes()))));
    named?;
    if status == StatusCode::PARTIAL_CONTENT {
        let value = format!("bytes {}-{}/{}", part.start, part.end - 1, blob.bytes);
        headers.insert(header::CONTENT_RANGE, HeaderValue::try_from(value)?);
    }
    Ok(response)
}

fn unsatisfiable(length: u64) -> ProblemResponse {
    let error = ProblemType::RangeNotSatisfiable.because(format!("the file has {length} bytes"));
    match HeaderValue::try_from(format!("bytes */{length}")) {
        Ok(value) => error.with_header(header::CONTENT_RANGE, value),
        Err(_) => error,
    }
}
