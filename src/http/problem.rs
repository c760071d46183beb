//! Faults on their way to the client: every 4xx and 5xx answer is an `application/problem+json` document
//! (RFC 9457). What the server itself did wrong is logged in full and told in one sentence.

use axum::{
    http::{HeaderName, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};

use crate::{
    domain::{JobId, Problem},
    store::{BlobError, StoreError},
};

/// Seconds after which a client may try again when the server was busy.
const RETRY_AFTER_SECONDS: u32 = 2;
/// The same where a job has to end first.
const RETRY_WHEN_A_JOB_ENDS: u32 = 30;

/// The error type of every handler.
#[derive(Debug, Clone)]
pub(super) struct Fault {
    problem: Box<Problem>,
    headers: Vec<(HeaderName, HeaderValue)>,
}

impl Fault {
    pub(super) fn new(status: StatusCode, name: &str, title: &str, detail: impl Into<String>) -> Self {
        Problem::new(status.as_u16(), name, title, detail).into()
    }

    pub(super) fn with(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.push((name, value));
        self
    }

    /// 422 about one query parameter.
    pub(super) fn parameter(name: &str, fault: impl std::fmt::Display) -> Self {
        Self::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "invalid-parameter",
            "Invalid parameter",
            format!("{name}: {fault}"),
        )
    }

    /// 404 for a job id that names nothing.
    pub(super) fn no_job(id: &str) -> Self {
        Self::new(
            StatusCode::NOT_FOUND,
            "job-not-found",
            "No such job",
            format!("there is no job '{}'", shown(id)),
        )
    }

    /// 404 for an id that names nothing of its kind.
    pub(super) fn nothing_called(name: &str, title: &str, kind: &str, id: &str) -> Self {
        Self::new(StatusCode::NOT_FOUND, name, title, format!("there is no {kind} '{}'", shown(id)))
    }

    /// 404 for a scene id that names nothing.
    pub(super) fn no_scene(id: impl std::fmt::Display) -> Self {
        let detail = format!("there is no scene '{}'", shown(&id.to_string()));
        Self::new(StatusCode::NOT_FOUND, "scene-not-found", "No such scene", detail)
    }

    /// 404 for an upload id that names nothing.
    pub(super) fn no_upload(id: &str) -> Self {
        let detail = format!("there is no upload '{}'", shown(id));
        Self::new(StatusCode::NOT_FOUND, "upload-not-found", "No such upload", detail)
    }

    /// 507 for want of room on the disk.
    pub(super) fn storage_full() -> Self {
        Self::new(
            StatusCode::INSUFFICIENT_STORAGE,
            "storage-full",
            "Storage full",
            "there is no room left on the server's disk, and nothing was kept; try again when the operator has made some",
        )
    }

    /// 409 for what only a succeeded job has.
    pub(super) fn no_file_yet(id: JobId, state: &str) -> Self {
        Self::new(
            StatusCode::CONFLICT,
            "no-artifact",
            "No file yet",
            format!("job {id} is {state}; only a succeeded job has a file"),
        )
    }

    /// 413, telling the limit.
    pub(super) fn too_large(limit: u64) -> Self {
        Self::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            "body-too-large",
            "Body too large",
            format!("the body is longer than the limit of {limit} bytes"),
        )
    }

    /// 503 with `Retry-After`.
    pub(super) fn busy(detail: &str) -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "busy", "Busy", detail)
            .with(header::RETRY_AFTER, RETRY_AFTER_SECONDS.into())
    }

    /// 500 that tells nothing; `error` goes to the log.
    pub(super) fn internal(error: &(dyn std::error::Error + 'static)) -> Self {
        tracing::error!(error, "internal error: {error}");
        internal().into()
    }
}

/// The problem of every internal error.
pub(super) fn internal() -> Problem {
    let detail = "the server met an internal error; its log has the particulars under this request id";
    Problem::new(500, "internal", "Internal error", detail)
}

/// The problem for an answer that came without one: the framework's own 404, 405 and the like.
pub(super) fn plain(status: StatusCode, method: &str, path: &str) -> Problem {
    let path = shown(path);
    let (name, detail) = match status {
        StatusCode::NOT_FOUND => {
            ("not-found", format!("there is nothing at {path}; /openapi.yaml lists what there is"))
        }
        StatusCode::METHOD_NOT_ALLOWED => (
            "method-not-allowed",
            format!("{path} does not take {method}; the Allow header lists what it takes"),
        ),
        status if status.is_server_error() => return internal(),
        _ => ("refused", format!("{method} {path} was refused")),
    };
    Problem::new(status.as_u16(), name, status.canonical_reason().unwrap_or("Refused"), detail)
}

/// A client's text as it may be repeated: not too long.
fn shown(text: &str) -> String {
    match text.char_indices().nth(200) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

impl From<Problem> for Fault {
    fn from(problem: Problem) -> Self {
        Self { problem: Box::new(problem), headers: Vec::new() }
    }
}

impl From<StoreError> for Fault {
    fn from(error: StoreError) -> Self {
        if error.is_disk_full() {
            tracing::error!(
                error = &error as &dyn std::error::Error,
                "no room left for the database: {error}"
            );
            return Self::storage_full();
        }
        if error.is_transient() {
            tracing::warn!(error = &error as &dyn std::error::Error, "the database is busy: {error}");
            return Self::busy("the database is busy");
        }
        match error {
            StoreError::QuotaExceeded { .. } => {
                let detail = format!("{error}; delete scenes, uploads or jobs to make room");
                Self::new(StatusCode::INSUFFICIENT_STORAGE, "quota-exceeded", "Over the key's quota", detail)
            }
            StoreError::TooManyJobs { .. } => {
                let detail = format!("{error}; wait until one has ended, or cancel one");
                Self::new(StatusCode::TOO_MANY_REQUESTS, "too-many-jobs", "Too many jobs at a time", detail)
                    .with(header::RETRY_AFTER, RETRY_WHEN_A_JOB_ENDS.into())
            }
            StoreError::NoDataset(id) => Self::no_scene(id),
            StoreError::PriorityTooHigh { .. } => Self::parameter("priority", error),
            error => Self::internal(&error),
        }
    }
}

impl From<BlobError> for Fault {
    fn from(error: BlobError) -> Self {
        match error {
            BlobError::TooLarge { limit } => Self::too_large(limit),
            error if error.is_disk_full() => {
                tracing::error!(error = &error as &dyn std::error::Error, "no room left: {error}");
                Self::storage_full()
            }
            error => Self::internal(&error),
        }
    }
}

impl IntoResponse for Fault {
    /// The problem rides along as an extension; [`super::wrap`] writes the body, once it knows the request id.
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.problem.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = status.into_response();
        response.headers_mut().extend(self.headers);
        response.extensions_mut().insert(*self.problem);
        response
    }
}
