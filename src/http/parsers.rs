//! Parsers of untrusted requests without the service around them, for fuzz targets; not part of the crate's API.

use axum::http::{HeaderMap, HeaderName, HeaderValue};

use super::{
    config::RequestLimits,
    problem::ProblemResponse,
    request::Parameters,
    uploads::tus::{AppendPartRequest, CreateUploadRequest, Metadata, expect_version},
    views::{ViewQuery, check_size},
};
use crate::domain::{Camera, NamedCamera, Problem};

/// The camera that the query of `GET /v1/jobs/{id}/view` asks for, within the default limits; `cameras` are the dataset's.
///
/// # Errors
/// The problem that answers the request.
pub fn view_query(query: Option<&str>, cameras: &[NamedCamera]) -> Result<Camera, Problem> {
    let parse = || {
        let ViewQuery { spec, .. } = ViewQuery::take(Parameters::parse(query)?)?;
        let camera = spec.resolve(cameras)?;
        check_size(&[camera], &RequestLimits::default())?;
        Ok(camera)
    };
    parse().map_err(ProblemResponse::into_problem)
}

/// The headers that a server would pass on; names and values that HTTP does not allow are left out.
#[must_use]
pub fn headers(lines: &[(&[u8], &[u8])]) -> HeaderMap {
    let parse = |(name, value): &(&[u8], &[u8])| {
        Some((HeaderName::from_bytes(name).ok()?, HeaderValue::from_bytes(value).ok()?))
    };
    let mut headers = HeaderMap::new();
    for (name, value) in lines.iter().filter_map(parse) {
        headers.append(name, value);
    }
    headers
}

/// Length and metadata that the headers of `POST /v1/uploads` state.
///
/// # Errors
/// The problem that answers the request.
pub fn create_upload(headers: &HeaderMap) -> Result<(u64, Option<String>), Problem> {
    let parse = || {
        expect_version(headers)?;
        let request = CreateUploadRequest::of(headers)?;
        Ok((request.length, request.metadata.map(Metadata::into_text)))
    };
    parse().map_err(ProblemResponse::into_problem)
}

/// Offset that the headers of `PATCH /v1/uploads/{id}` state, and whether `content` has the checksum that they announce, if any.
///
/// # Errors
/// The problem that answers the request.
pub fn append_part(headers: &HeaderMap, content: &[u8]) -> Result<(u64, Option<bool>), Problem> {
    let parse = || {
        expect_version(headers)?;
        let request = AppendPartRequest::of(headers)?;
        let matches = request.checksum.map(|mut checksum| {
            checksum.update(content);
            checksum.matches()
        });
        Ok((request.offset, matches))
    };
    parse().map_err(ProblemResponse::into_problem)
}
