//! The finished file: whole or in part, with a digest of the whole.

use axum::{
    body::Body,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};

use super::{
    etag::{Etag, not_modified},
    jobs::find,
    problem::Fault,
    query::Parameters,
    range::{Wanted, wanted},
    state::AppState,
};
use crate::{
    domain::{Caller, Digest},
    store::{JobRecord, SceneArtifact},
};

/// Takes the parameter that chooses among the files of a rate-distortion curve.
pub(super) fn take_lambda(parameters: &mut Parameters) -> Result<Option<f64>, Fault> {
    parameters.take_as("lambda", "a number")
}

/// The job's file of weight `lambda`, or its first; 409 where there is none yet, 404 where none has that weight.
pub(super) fn file_of(record: &JobRecord, lambda: Option<f64>) -> Result<SceneArtifact, Fault> {
    let first = record.scenes().next();
    let first = first.ok_or_else(|| Fault::no_file_yet(record.job.id, record.job.state.name()))?;
    match lambda {
        None => Ok(first),
        Some(_) => record.scenes().find(|scene| scene.lambda == lambda).ok_or_else(|| no_such_lambda(record)),
    }
}

fn no_such_lambda(record: &JobRecord) -> Fault {
    let known: Vec<String> =
        record.scenes().filter_map(|scene| scene.lambda).map(|lambda| lambda.to_string()).collect();
    let detail = if known.is_empty() {
        format!("job {} has one file, not the files of an rd_curve; leave out lambda", record.job.id)
    } else {
        format!("job {} has files of lambda {}", record.job.id, known.join(", "))
    };
    Fault::new(StatusCode::NOT_FOUND, "no-such-lambda", "No such file", detail)
}

/// `GET` and `HEAD /v1/jobs/{id}/artifact`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
    request: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let mut parameters = Parameters::parse(query.as_deref())?;
    let lambda = take_lambda(&mut parameters)?;
    parameters.finish()?;
    let SceneArtifact { format, lambda, blob: file } = file_of(&record, lambda)?;
    let etag = Etag::new(file.digest);
    if etag.is_in_if_none_match(&request) {
        return Ok(not_modified(&etag));
    }
    let range = request.get(header::RANGE).filter(|_| etag.allows_range(&request));
    let (status, part) = match wanted(range.and_then(|value| value.to_str().ok()), file.bytes) {
        Wanted::Whole => (StatusCode::OK, 0..file.bytes),
        Wanted::Part(part) => (StatusCode::PARTIAL_CONTENT, part),
        Wanted::Unsatisfiable => return Err(unsatisfiable(file.bytes)),
    };
    let body = if part.is_empty() {
        Body::empty()
    } else {
        Body::from_stream(state.blobs().stream(file.digest, part.clone()).await?)
    };
    let mut response = (status, body).into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(format.media_type()));
    headers.insert(header::CONTENT_LENGTH, HeaderValue::from(part.end - part.start));
    headers.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    headers.insert(header::ETAG, etag.value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, max-age=31536000, immutable"));
    let mut text = |name: &'static str, value: String| {
        HeaderValue::try_from(value).map(|value| headers.insert(name, value))
    };
    let point = lambda.map_or_else(String::new, |lambda| format!(".lambda-{lambda}"));
    let name = format!("{}{point}.{}", record.job.id, format.name());
    let named = text("content-disposition", format!("attachment; filename=\"{name}\""))
        .and(text("repr-digest", format!("sha-256=:{}:", base64(&file.digest))));
    named.map_err(|error| Fault::internal(&error))?;
    if status == StatusCode::PARTIAL_CONTENT {
        let value = format!("bytes {}-{}/{}", part.start, part.end - 1, file.bytes);
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
