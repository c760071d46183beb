//! Reads request bodies, bounded in length, pauses and total time.

use std::time::Duration;

use axum::{
    body::BodyDataStream,
    extract::{FromRequest, Request},
    http::{HeaderMap, header},
};
use bytes::Bytes;
use futures_util::StreamExt as _;
use serde::{
    Deserialize, Deserializer,
    de::{DeserializeOwned, IgnoredAny},
};
use tokio::time::{Instant, timeout, timeout_at};

use crate::{
    domain::ProblemType,
    http::{
        config::RequestLimits,
        problem::{ApiResult, ProblemResponse},
        state::AppState,
    },
};

/// The media type of a request, without its parameters, in lower case.
pub(crate) fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next().unwrap_or_default().trim().to_ascii_lowercase())
}

/// 415 unless the media type is one of `accepted`.
pub(crate) fn expect_media_type(headers: &HeaderMap, accepted: &[&str]) -> ApiResult<()> {
    let given = media_type(headers);
    if given.as_deref().is_some_and(|given| accepted.contains(&given)) {
        return Ok(());
    }
    Err(ProblemType::UnsupportedMediaType.because(format!(
        "the Content-Type is {}; send {}",
        given.as_deref().unwrap_or("missing"),
        accepted.join(" or ")
    )))
}

/// A request body in JSON.
pub(crate) trait JsonBody: DeserializeOwned {
    /// The problem of JSON that is not such a body.
    const INVALID: ProblemType = ProblemType::InvalidParameter;
    /// What the body is, with its article.
    const EXPECTED: &'static str;
}

/// Reads a field that was given, `null` too, so that it differs from one that was not.
pub(crate) fn present<'de, T: Deserialize<'de>, D: Deserializer<'de>>(
    value: D,
) -> Result<Option<T>, D::Error> {
    T::deserialize(value).map(Some)
}

/// Extracts a JSON body within the limits on bodies.
#[derive(Debug)]
pub(crate) struct ApiJson<T>(pub(crate) T);

impl<T: JsonBody> FromRequest<AppState> for ApiJson<T> {
    type Rejection = ProblemResponse;

    async fn from_request(request: Request, state: &AppState) -> ApiResult<Self> {
        let (parts, body) = request.into_parts();
        let content = read_json(&mut body.into_data_stream(), &parts.headers, &state.limits).await?;
        parse_json(&content).map(Self)
    }
}

/// Reads a JSON body from memory.
///
/// # Errors
/// 400 for malformed JSON, [`JsonBody::INVALID`] for JSON of another shape.
pub(crate) fn parse_json<T: JsonBody>(content: &[u8]) -> ApiResult<T> {
    // serde reads a struct from an array too, by the order of its fields; no body of the contract is one.
    if content.trim_ascii_start().first() == Some(&b'[')
        && serde_json::from_slice::<IgnoredAny>(content).is_ok()
    {
        return Err(T::INVALID.because(format!("body: is not {}: it is an array", T::EXPECTED)));
    }
    serde_json::from_slice(content).map_err(|error| {
        if error.is_data() {
            T::INVALID.because(format!("body: is not {}: {error}", T::EXPECTED))
        } else {
            ProblemType::MalformedJson.because(format!("the body is not JSON: {error}"))
        }
    })
}

/// Reads a JSON body into memory.
pub(crate) async fn read_json(
    body: &mut BodyDataStream,
    headers: &HeaderMap,
    limits: &RequestLimits,
) -> ApiResult<Vec<u8>> {
    expect_media_type(headers, &["application/json"])?;
    announced_length(headers, limits.json_bytes)?;
    let mut content = Vec::new();
    let mut pieces = Pieces::new(body, limits);
    while let Some(piece) = pieces.next().await? {
        if (content.len() + piece.len()) as u64 > limits.json_bytes {
            return Err(ProblemResponse::too_large(limits.json_bytes));
        }
        content.extend_from_slice(&piece);
    }
    Ok(content)
}

/// Reads a JSON body into memory, if there is one. An empty body counts as none: generated clients send its type nevertheless.
pub(crate) async fn read_optional_json(
    body: &mut BodyDataStream,
    headers: &HeaderMap,
    limits: &RequestLimits,
) -> ApiResult<Option<Vec<u8>>> {
    if media_type(headers).is_none() {
        let mut pieces = Pieces::new(body, limits);
        loop {
            match pieces.next().await? {
                None => return Ok(None),
                Some(piece) if piece.is_empty() => {}
                Some(_) => expect_media_type(headers, &["application/json"])?,
            }
        }
    }
    let content = read_json(body, headers, limits).await?;
    Ok((!content.is_empty()).then_some(content))
}

/// The announced length of a body.
///
/// # Errors
/// 413 for more than `limit`.
pub(crate) fn announced_length(headers: &HeaderMap, limit: u64) -> ApiResult<Option<u64>> {
    let announced =
        headers.get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
    if announced.is_some_and(|announced| announced > limit) {
        return Err(ProblemResponse::too_large(limit));
    }
    Ok(announced)
}

/// A body piece by piece, within the limits on time.
pub(crate) struct Pieces<'a> {
    body: &'a mut BodyDataStream,
    idle: Duration,
    /// Least bytes per second, on average since the start.
    rate: u64,
    begun: Instant,
    deadline: Instant,
    received: u64,
}

impl<'a> Pieces<'a> {
    pub(crate) fn new(body: &'a mut BodyDataStream, limits: &RequestLimits) -> Self {
        let begun = Instant::now();
        let deadline = begun + limits.body_timeout;
        Self {
            body,
            idle: limits.body_idle_timeout,
            rate: limits.min_body_rate,
            begun,
            deadline,
            received: 0,
        }
    }

    /// The next piece; `None` at the end.
    pub(crate) async fn next(&mut self) -> ApiResult<Option<Bytes>> {
        let piece = timeout_at(self.deadline, timeout(self.idle, self.body.next()));
        match piece.await {
            Ok(Ok(None)) => Ok(None),
            Ok(Ok(Some(Ok(piece)))) => {
                self.received += piece.len() as u64;
                if self.dribbles() { Err(self.too_slow()) } else { Ok(Some(piece)) }
            }
            Ok(Ok(Some(Err(error)))) => Err(ProblemType::BodyIncomplete
                .because(format!("the body could not be read to its end: {error}"))),
            Ok(Err(_)) | Err(_) => Err(self.too_slow()),
        }
    }

    /// Whether the body is too slow on average although no piece was late, as from a client that means to hold its place.
    fn dribbles(&self) -> bool {
        let elapsed = self.begun.elapsed();
        elapsed > self.idle && (self.received as f64) < self.rate as f64 * elapsed.as_secs_f64()
    }

    fn too_slow(&self) -> ProblemResponse {
        ProblemType::BodyTimeout.because(format!(
            "the body paused for more than {} s, brought less than {} bytes a second, or was not complete in time",
            self.idle.as_secs_f64(),
            self.rate
        ))
    }
}
