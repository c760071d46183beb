//! Reads request bodies, bounded in length, pauses and total time.

use std::time::Duration;

use axum::{
    body::BodyDataStream,
    extract::{FromRequest, Request},
    http::{HeaderMap, HeaderValue, header},
};
use bytes::Bytes;
use futures_util::StreamExt as _;
use serde::{
    Deserialize, Deserializer,
    de::{DeserializeOwned, IgnoredAny},
};
use serde_json::Value;
use tokio::time::{Instant, timeout, timeout_at};

use crate::{
    domain::ProblemType,
    http::{
        config::RequestLimits,
        problem::{Answer as _, ApiResult, ProblemResponse},
        state::AppState,
    },
};

/// The media type of a request, without its parameters, in lower case.
pub(crate) fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next().unwrap_or_default().trim().to_ascii_lowercase())
}

/// 415 for a body in a content coding, such as gzip: none is decoded, since what a body unpacks to has no bound here.
pub(crate) fn expect_no_coding(headers: &HeaderMap) -> ApiResult<()> {
    let given = headers.get_all(header::CONTENT_ENCODING);
    let coding =
        given.iter().find(|coding| !coding.as_bytes().trim_ascii().eq_ignore_ascii_case(b"identity"));
    coding.map_or(Ok(()), |coding| {
        let coding: String = String::from_utf8_lossy(coding.as_bytes()).chars().take(40).collect();
        Err(ProblemType::UnsupportedMediaType
            .because(format!(
                "the Content-Encoding is {coding}; send the body as it is, without a content coding"
            ))
            .with_header(header::ACCEPT_ENCODING, HeaderValue::from_static("identity")))
    })
}

/// 415 unless the media type is one of `accepted`, without a content coding.
pub(crate) fn expect_media_type(headers: &HeaderMap, accepted: &[&str]) -> ApiResult<()> {
    expect_no_coding(headers)?;
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

/// Beyond, not every whole number has a 64-bit float.
const MAX_EXACT: f64 = 9_007_199_254_740_992.0;

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
    let read = serde_json::from_slice(content).or_else(|error| {
        // JSON knows one kind of number: 7.0 is a whole one.
        let mut value: Value = serde_json::from_slice(content).map_err(|_| error)?;
        whole_numbers(&mut value);
        serde_json::from_value(value)
    });
    read.map_err(|error| {
        if error.is_data() {
            T::INVALID.because(format!("body: is not {}: {error}", T::EXPECTED))
        } else {
            ProblemType::MalformedJson.because(format!("the body is not JSON: {error}"))
        }
    })
}

/// Writes whole numbers without a fraction, wherever they are.
pub(crate) fn whole_numbers(value: &mut Value) {
    match value {
        Value::Number(number) if number.is_f64() => {
            let whole = number.as_f64().filter(|number| number.fract() == 0.0 && number.abs() < MAX_EXACT);
            if let Some(whole) = whole {
                *value = Value::from(whole as i64);
            }
        }
        Value::Array(items) => items.iter_mut().for_each(whole_numbers),
        Value::Object(fields) => fields.values_mut().for_each(whole_numbers),
        _ => {}
    }
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
    started: Instant,
    deadline: Instant,
    received: u64,
}

impl<'a> Pieces<'a> {
    pub(crate) fn new(body: &'a mut BodyDataStream, limits: &RequestLimits) -> Self {
        let started = Instant::now();
        let deadline = started + limits.body_timeout;
        Self {
            body,
            idle: limits.body_idle_timeout,
            rate: limits.min_body_rate,
            started,
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
                if self.is_too_slow() { Err(self.too_slow()) } else { Ok(Some(piece)) }
            }
            Ok(Ok(Some(Err(error)))) => Err(ProblemType::BodyIncomplete
                .because(format!("the body could not be read to its end: {error}"))),
            Ok(Err(_)) | Err(_) => Err(self.too_slow()),
        }
    }

    /// Whether the body is too slow on average although no piece was late, as from a client that means to hold its place.
    fn is_too_slow(&self) -> bool {
        let elapsed = self.started.elapsed();
        elapsed > self.idle && (self.received as f64) < self.rate as f64 * elapsed.as_secs_f64()
    }

    fn too_slow(&self) -> ProblemResponse {
        ProblemType::BodyTimeout.because(format!(
            "the body paused for more than {} s, brought less than {} bytes per second, or was not complete in time",
            self.idle.as_secs_f64(),
            self.rate
        ))
    }
}

#[cfg(test)]
mod tests {
    use axum::body::Body;
    use futures_util::stream;

    use super::*;
    use crate::domain::Problem;

    #[derive(Debug, Deserialize)]
    struct Pair {
        #[expect(dead_code, reason = "only read")]
        first: u32,
    }

    impl JsonBody for Pair {
        const EXPECTED: &'static str = "a pair";
    }

    #[test]
    fn a_media_type_is_known_with_parameters_and_in_any_case() {
        let with = |value: &'static str| {
            let headers = HeaderMap::from_iter([(header::CONTENT_TYPE, value.parse().expect("a value"))]);
            expect_media_type(&headers, &["application/json"]).is_ok()
        };
        for json in ["application/json", "Application/JSON; charset=UTF-8", "application/json;charset=utf-8"]
        {
            assert!(with(json), "{json}");
        }
        assert!(!with("application/json+ld") && !with("text/plain; application/json"));
    }

    #[test]
    fn a_content_coding_is_called_by_its_name() {
        let with = |value: &'static str| {
            let headers = HeaderMap::from_iter([(header::CONTENT_ENCODING, value.parse().expect("a value"))]);
            expect_no_coding(&headers).map_err(|problem| problem.into_problem().detail)
        };
        assert!(
            expect_no_coding(&HeaderMap::new()).is_ok()
                && with("identity").is_ok()
                && with("Identity ").is_ok()
        );
        for coding in ["gzip", "br", "zstd", "deflate, gzip"] {
            let detail = with(coding).expect_err(coding);
            assert!(detail.starts_with(&format!("the Content-Encoding is {coding};")), "{detail}");
        }
    }

    #[test]
    fn an_array_is_no_object_and_half_of_one_is_no_json() {
        for (content, expected) in [
            ("[1]", ProblemType::InvalidParameter),
            (" \n[1]", ProblemType::InvalidParameter),
            ("[1", ProblemType::MalformedJson),
            ("{\"first\": -1}", ProblemType::InvalidParameter),
        ] {
            let error = parse_json::<Pair>(content.as_bytes()).expect_err("no pair").into_problem();
            assert_eq!(error.kind, Problem::new(expected, "").kind, "{content}");
        }
        parse_json::<Pair>(b" {\"first\": 1}").expect("a pair");
        // As JSON Schema counts.
        parse_json::<Pair>(b"{\"first\": 2353.0}").expect("a pair");
        parse_json::<Pair>(b"{\"first\": 1.5}").expect_err("no whole number");
    }

    #[test]
    fn a_long_body_is_given_up_only_while_it_is_slower_than_the_rate() {
        let limits = RequestLimits {
            body_idle_timeout: Duration::from_secs(60),
            min_body_rate: 100,
            ..RequestLimits::default()
        };
        let mut body = Body::empty().into_data_stream();
        let mut is_too_slow = |lasted: u64, received: u64| {
            let mut pieces = Pieces::new(&mut body, &limits);
            pieces.started = Instant::now().checked_sub(Duration::from_secs(lasted)).expect("an instant");
            pieces.received = received;
            pieces.is_too_slow()
        };
        assert!(!is_too_slow(30, 0), "a pause is allowed");
        assert!(!is_too_slow(600, 1 << 20));
        assert!(is_too_slow(600, 50_000));
    }

    #[tokio::test]
    async fn a_whole_body_has_a_time_too() {
        let limits = RequestLimits {
            body_idle_timeout: Duration::from_secs(3600),
            body_timeout: Duration::from_millis(20),
            ..RequestLimits::default()
        };
        let mut body =
            Body::from_stream(stream::pending::<Result<Bytes, std::io::Error>>()).into_data_stream();
        let mut pieces = Pieces::new(&mut body, &limits);
        let error = timeout(Duration::from_secs(60), pieces.next()).await.expect("given up");
        let error = error.expect_err("too slow").into_problem();
        assert_eq!(error.kind, Problem::new(ProblemType::BodyTimeout, "").kind);
    }
}
