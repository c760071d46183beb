//! HTTP requests to one service. Transport errors and responses other than success become problems.

use std::time::Duration;

use bytes::Bytes;
use reqwest::{
    Method, Request, RequestBuilder, Response, StatusCode, Url,
    header::{ACCEPT, AUTHORIZATION, CONTENT_LENGTH, CONTENT_TYPE, HeaderMap, HeaderValue, RETRY_AFTER},
};
use serde::de::DeserializeOwned;
use tcgs::domain::{Problem, ProblemType};
use tokio::time::timeout;
use uuid::Uuid;

use crate::cli::CliError;

/// Timeouts of connecting, and of waiting for the next bytes of a response.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
const KEEPALIVE: Duration = Duration::from_secs(15);
const READ_TIMEOUT: Duration = Duration::from_secs(120);
/// Timeout of the response to a request that makes something: a dataset is checked before, after those that came earlier.
const CREATION_TIMEOUT: Duration = Duration::from_secs(600);
/// Slowest connection on which a request is sent to its end, in bytes per second.
const SLOWEST: u64 = 32 << 10;
/// How long a request is repeated while the service still answers an earlier one for the same thing, and the longest pause meanwhile.
const UNDER_WAY_TIMEOUT: Duration = Duration::from_secs(600);
const UNDER_WAY_PAUSE: Duration = Duration::from_secs(5);
/// Largest response that is read as a document.
const DOCUMENT_BYTES: usize = 64 << 20;
/// Attempts of a repeatable request, and the pauses between them.
const TRIES: u32 = 5;
const FIRST_PAUSE: Duration = Duration::from_millis(200);
const MAX_PAUSE: Duration = Duration::from_secs(30);

/// The address of a service.
fn service_address(server: &str) -> Result<Url, String> {
    if !server.contains("://") {
        return Err(format!("--server: '{server}' has no scheme; write http://{server}"));
    }
    let base = Url::parse(server).map_err(|error| format!("--server: '{server}': {error}"))?;
    if !matches!(base.scheme(), "http" | "https") || base.host_str().is_none() {
        return Err(format!("--server: '{server}' is not an http or https address"));
    }
    Ok(base)
}

/// A service and the API key for it.
#[derive(Debug, Clone)]
pub(super) struct Connection {
    client: reqwest::Client,
    base: Url,
    /// Where the key comes from, for messages.
    key_source: String,
}

impl Connection {
    /// A connection to the service at `server`; sends nothing yet.
    pub(super) fn new(server: &str, key: Option<&str>, key_source: String) -> Result<Self, CliError> {
        let base = service_address(server).map_err(CliError::Usage)?;
        let mut headers = HeaderMap::new();
        if let Some(key) = key {
            let mut value = HeaderValue::try_from(format!("Bearer {key}"))
                .map_err(|_| CliError::Usage("the API key has characters that no key has".to_owned()))?;
            value.set_sensitive(true);
            headers.insert(AUTHORIZATION, value);
        }
        let unusable = |error: String| Problem::new(ProblemType::NoClient, error);
        let builder = tcgs::https::client_builder().map_err(|error| unusable(error.to_string()))?;
        let client = builder
            .default_headers(headers)
            .connect_timeout(CONNECT_TIMEOUT)
            // No timeout for reading here: it would also count the time in which a request is sent.
            .tcp_keepalive(KEEPALIVE)
            // The key must not be sent to the target of a redirect.
            .redirect(reqwest::redirect::Policy::none())
            .build()
            .map_err(|error| unusable(error.to_string()))?;
        Ok(Self { client, base, key_source })
    }

    /// A request to a path of the service.
    pub(super) fn request(&self, method: Method, path: &str) -> Result<RequestBuilder, CliError> {
        let url = format!("{}{path}", self.base.as_str().trim_end_matches('/'));
        let url = Url::parse(&url).map_err(|error| CliError::Usage(format!("'{path}': {error}")))?;
        Ok(self.client.request(method, url))
    }

    /// Sends a request once; a response other than success is returned as its problem.
    pub(super) async fn send(&self, request: RequestBuilder) -> Result<Response, CliError> {
        self.accepted(self.response(request).await?).await
    }

    /// The response to a request, whatever its status. The time for it grows with the bytes to be sent.
    pub(super) async fn response(&self, request: RequestBuilder) -> Result<Response, CliError> {
        let unreachable = |error: reqwest::Error| unreachable(&self.base, &error);
        let request = request.build().map_err(unreachable)?;
        let limit = time_limit(&request);
        match timeout(limit, self.client.execute(request)).await {
            Ok(response) => response.map_err(unreachable),
            Err(_) => {
                let detail = format!("{} does not answer within {} s", self.base, limit.as_secs());
                Err(Problem::new(ProblemType::Unreachable, detail).into())
            }
        }
    }

    /// Sends the request that `make` creates and repeats it while the service is unreachable, busy, or answering an earlier one for the
    /// same thing; for idempotent requests only.
    pub(super) async fn send_with_retry(
        &self,
        make: impl AsyncFn() -> Result<RequestBuilder, CliError>,
    ) -> Result<Response, CliError> {
        let (mut pause, mut tries, mut waited) = (FIRST_PAUSE, 1, Duration::ZERO);
        loop {
            match self.response(make().await?).await {
                Ok(response) if tries < TRIES && is_busy(response.status()) => {
                    tries += 1;
                    sleep(wanted_pause(&response).unwrap_or(pause)).await;
                }
                Ok(response) => match self.accepted(response).await {
                    Err(error) if waited < UNDER_WAY_TIMEOUT && is_under_way(&error) => {
                        pause = pause.min(UNDER_WAY_PAUSE);
                        waited += pause;
                        sleep(pause).await;
                    }
                    done => return done,
                },
                Err(_) if tries < TRIES => {
                    tries += 1;
                    sleep(pause).await;
                }
                Err(error) => return Err(error),
            }
            pause *= 2;
        }
    }

    /// Posts a JSON document with an idempotency key, so that a repeated request has no second effect.
    pub(super) async fn post(&self, path: &str, document: &serde_json::Value) -> Result<Response, CliError> {
        let (key, text) = (Uuid::now_v7().to_string(), document.to_string());
        let make = async || {
            let request = self.request(Method::POST, path)?.header("idempotency-key", &key);
            Ok(request.header(CONTENT_TYPE, "application/json").body(text.clone()))
        };
        self.send_with_retry(make).await
    }

    /// The JSON document at a path.
    pub(super) async fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, CliError> {
        let ask = async || Ok(self.request(Method::GET, path)?.header(ACCEPT, "application/json"));
        document(self.send_with_retry(ask).await?).await
    }

    /// The response, or its problem if it is no success.
    async fn accepted(&self, response: Response) -> Result<Response, CliError> {
        let status = response.status();
        if status.is_success() || status == StatusCode::NOT_MODIFIED {
            return Ok(response);
        }
        let body = body(response).await?;
        let mut problem = serde_json::from_slice::<Problem>(&body).unwrap_or_else(|_| {
            let said: String = String::from_utf8_lossy(&body).chars().take(200).collect();
            let detail = format!("the service answered {status}: {}", said.trim());
            Problem::new(ProblemType::Refused, detail).with_status(status.as_u16())
        });
        if status == StatusCode::UNAUTHORIZED {
            let source = &self.key_source;
            problem.detail += &format!(
                ". This command takes the key from {source}; --key-env and --key-file name another place"
            );
        }
        Err(problem.into())
    }
}

/// Waits, at most [`MAX_PAUSE`].
pub(super) async fn sleep(pause: Duration) {
    tokio::time::sleep(pause.min(MAX_PAUSE)).await;
}

/// The JSON body of a response.
pub(super) async fn document<T: DeserializeOwned>(response: Response) -> Result<T, CliError> {
    let body = body(response).await?;
    serde_json::from_slice(&body)
        .map_err(|error| unexpected(format!("its answer is not what was expected: {error}")))
}

/// The body of a response, of at most [`DOCUMENT_BYTES`].
pub(super) async fn body(mut response: Response) -> Result<Vec<u8>, CliError> {
    let mut body = Vec::new();
    while let Some(piece) = next_piece(&mut response).await? {
        if body.len() + piece.len() > DOCUMENT_BYTES {
            return Err(unexpected(format!("its answer is longer than {DOCUMENT_BYTES} bytes")));
        }
        body.extend_from_slice(&piece);
    }
    Ok(body)
}

/// The next piece of a response's body.
pub(super) async fn next_piece(response: &mut Response) -> Result<Option<Bytes>, CliError> {
    match timeout(READ_TIMEOUT, response.chunk()).await {
        Ok(piece) => piece.map_err(|error| unexpected(format!("its answer broke off: {}", root(&error)))),
        Err(_) => Err(unexpected(format!("its answer paused for {} s", READ_TIMEOUT.as_secs()))),
    }
}

/// The longest time from the start of a request to the head of its response.
fn time_limit(request: &Request) -> Duration {
    let announced =
        request.headers().get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
    let given = || request.body().and_then(|body| body.as_bytes()).map_or(0, <[u8]>::len) as u64;
    let sending = Duration::from_secs(announced.unwrap_or_else(given) / SLOWEST);
    sending + if request.method() == Method::POST { CREATION_TIMEOUT } else { READ_TIMEOUT }
}

/// A fault of the service's, not of the request.
pub(super) fn unexpected(detail: impl AsRef<str>) -> CliError {
    Problem::new(ProblemType::UnexpectedAnswer, detail.as_ref()).into()
}

/// A transport error.
pub(super) fn unreachable(base: &Url, error: &reqwest::Error) -> CliError {
    let detail = match tcgs::https::certificate_error(error) {
        Some(reason) => format!("the certificate of {base} {reason}"),
        None => format!("{base} does not answer: {}", root(error)),
    };
    Problem::new(ProblemType::Unreachable, detail).into()
}

/// The innermost cause of an error, in one line.
fn root(error: &reqwest::Error) -> String {
    let mut deepest: &dyn std::error::Error = error;
    while let Some(source) = deepest.source() {
        deepest = source;
    }
    deepest.to_string()
}

fn is_busy(status: StatusCode) -> bool {
    matches!(
        status,
        StatusCode::TOO_MANY_REQUESTS
            | StatusCode::BAD_GATEWAY
            | StatusCode::SERVICE_UNAVAILABLE
            | StatusCode::GATEWAY_TIMEOUT
    )
}

/// Whether the service still answers an earlier request for the same thing.
fn is_under_way(error: &CliError) -> bool {
    let under_way = [ProblemType::UploadLocked, ProblemType::IdempotencyInFlight];
    matches!(error, CliError::Problem(problem) if under_way.iter().any(|kind| problem.is(*kind)))
}

/// The pause that the service asks for in `Retry-After`.
pub(super) fn wanted_pause(response: &Response) -> Option<Duration> {
    let seconds = response.headers().get(RETRY_AFTER)?.to_str().ok()?.parse().ok()?;
    Some(Duration::from_secs(seconds))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn connection(server: &str, key: Option<&str>) -> Result<Connection, CliError> {
        Connection::new(server, key, "the variable TCGS_API_KEY".to_owned())
    }

    #[test]
    fn addresses_and_keys_that_cannot_be_are_wrong_usage() {
        for server in ["", "localhost:8080", "ftp://a", "http://", "file:///tmp"] {
            let error = connection(server, None).expect_err(server);
            assert_eq!(error.exit_status(), 2, "{server}: {error}");
        }
        let error = connection("http://a", Some("line\nbreak")).expect_err("no header");
        assert!(error.exit_status() == 2 && !error.to_string().contains("break"), "{error}");
    }

    #[test]
    fn time_for_a_response_grows_with_what_is_sent_and_creations_have_more() {
        let connection = connection("http://a", None).expect("a connection");
        let limit = |method: Method, bytes: usize| {
            let request = connection.request(method, "/v1/uploads").expect("a request").body(vec![7; bytes]);
            time_limit(&request.build().expect("whole"))
        };
        assert_eq!(limit(Method::GET, 0), READ_TIMEOUT);
        assert_eq!(limit(Method::POST, 100), CREATION_TIMEOUT);
        let part = limit(Method::PATCH, 16 << 20);
        assert!(part >= Duration::from_secs(512), "16 MiB at a quarter of a megabit a second: {part:?}");
    }

    #[test]
    fn the_key_is_not_shown_and_paths_are_put_behind_the_address() {
        let connection = connection("http://a.example/tcgs/", Some("tcgs_secret")).expect("a connection");
        let request = connection.request(Method::GET, "/v1/jobs?limit=1").expect("a request");
        let request = request.build().expect("whole");
        assert_eq!(request.url().as_str(), "http://a.example/tcgs/v1/jobs?limit=1");
        assert!(!format!("{connection:?} {request:?}").contains("secret"));
    }

    #[test]
    fn an_address_without_a_scheme_is_shown_with_one() {
        for server in ["127.0.0.1:19000", "localhost:19000", "example.com"] {
            let error = service_address(server).expect_err(server);
            assert!(error.contains(&format!("write http://{server}")), "{error}");
        }
        service_address("http://127.0.0.1:19000").expect("an address");
        assert!(service_address("ftp://example.com").expect_err("no HTTP").contains("http or https"));
    }
}
