//! Reading request bodies: bounded in length, in pauses and in time as a whole.

use std::time::Duration;

use axum::{
    body::BodyDataStream,
    http::{HeaderMap, StatusCode, header},
};
use bytes::Bytes;
use futures_util::StreamExt as _;
use tokio::time::{Instant, timeout, timeout_at};

use super::{config::RequestLimits, problem::Fault};

/// The media type of a request, without its parameters, in lower case.
pub(super) fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next().unwrap_or_default().trim().to_ascii_lowercase())
}

/// 415 unless the media type is one of `accepted`.
pub(super) fn expect_media_type(headers: &HeaderMap, accepted: &[&str]) -> Result<(), Fault> {
    let given = media_type(headers);
    if given.as_deref().is_some_and(|given| accepted.contains(&given)) {
        return Ok(());
    }
    Err(Fault::new(
        StatusCode::UNSUPPORTED_MEDIA_TYPE,
        "unsupported-media-type",
        "Unsupported media type",
        format!(
            "the Content-Type is {}; send {}",
            given.as_deref().unwrap_or("missing"),
            accepted.join(" or ")
        ),
    ))
}

/// Reads a JSON body into memory.
pub(super) async fn read_json(
    body: &mut BodyDataStream,
    headers: &HeaderMap,
    limits: &RequestLimits,
) -> Result<Vec<u8>, Fault> {
    expect_media_type(headers, &["application/json"])?;
    announced_length(headers, limits.json_bytes)?;
    let mut content = Vec::new();
    let mut pieces = Pieces::new(body, limits);
    while let Some(piece) = pieces.next().await? {
        if (content.len() + piece.len()) as u64 > limits.json_bytes {
            return Err(Fault::too_large(limits.json_bytes));
        }
        content.extend_from_slice(&piece);
    }
    Ok(content)
}

/// Reads a JSON body into memory, if there is a body. An empty one is none: generated clients name its type nevertheless.
pub(super) async fn read_optional_json(
    body: &mut BodyDataStream,
    headers: &HeaderMap,
    limits: &RequestLimits,
) -> Result<Option<Vec<u8>>, Fault> {
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

/// The length that a body is announced to have, if it is.
///
/// # Errors
/// 413 for more than `limit`.
pub(super) fn announced_length(headers: &HeaderMap, limit: u64) -> Result<Option<u64>, Fault> {
    let announced =
        headers.get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
    if announced.is_some_and(|announced| announced > limit) {
        return Err(Fault::too_large(limit));
    }
    Ok(announced)
}

/// A body piece by piece, within the limits on time.
pub(super) struct Pieces<'a> {
    body: &'a mut BodyDataStream,
    idle: Duration,
    /// Bytes a second, on average since the begin.
    rate: u64,
    begun: Instant,
    deadline: Instant,
    received: u64,
}

impl<'a> Pieces<'a> {
    pub(super) fn new(body: &'a mut BodyDataStream, limits: &RequestLimits) -> Self {
        let begun = Instant::now();
        let deadline = begun + limits.body_total;
        Self { body, idle: limits.body_idle, rate: limits.body_rate, begun, deadline, received: 0 }
    }

    /// The next piece, none at the end.
    pub(super) async fn next(&mut self) -> Result<Option<Bytes>, Fault> {
        let piece = timeout_at(self.deadline, timeout(self.idle, self.body.next()));
        match piece.await {
            Ok(Ok(None)) => Ok(None),
            Ok(Ok(Some(Ok(piece)))) => {
                self.received += piece.len() as u64;
                if self.dribbles() { Err(self.too_slow()) } else { Ok(Some(piece)) }
            }
            Ok(Ok(Some(Err(error)))) => Err(Fault::new(
                StatusCode::BAD_REQUEST,
                "body-incomplete",
                "Body incomplete",
                format!("the body could not be read to its end: {error}"),
            )),
            Ok(Err(_)) | Err(_) => Err(self.too_slow()),
        }
    }

    /// Whether the pieces, none of which was late, together bring too little: what a client does that means to keep a place
    /// for as long as it can.
    fn dribbles(&self) -> bool {
        let elapsed = self.begun.elapsed();
        elapsed > self.idle && (self.received as f64) < self.rate as f64 * elapsed.as_secs_f64()
    }

    fn too_slow(&self) -> Fault {
        Fault::new(
            StatusCode::REQUEST_TIMEOUT,
            "body-timeout",
            "Body too slow",
            format!(
                "the body paused for more than {} s, brought less than {} bytes a second, or was not complete in time",
                self.idle.as_secs_f64(),
                self.rate
            ),
        )
    }
}
