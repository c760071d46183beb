//! Problems on their way to the client: every 4xx and 5xx answer is an `application/problem+json` document (RFC 9457). Internal
//! errors are logged with their causes; the client gets one sentence.

use std::{error::Error, fmt::Display};

use axum::{
    http::{
        HeaderName, HeaderValue, StatusCode,
        header::{self, InvalidHeaderValue},
    },
    response::{IntoResponse, Response},
};
use tokio::{sync::AcquireError, task::JoinError};

use crate::{
    domain::{JobId, Preparation, Problem, ProblemType},
    store::{BlobError, StoreError},
};

/// `Retry-After` of a 503 that names no other, in seconds.
const RETRY_AFTER_SECONDS: u32 = 2;
/// `Retry-After` of a request that waits for a job to end, in seconds.
const RETRY_WHEN_A_JOB_ENDS: u32 = 30;
/// `Retry-After` of a project that has as many open uploads as it may.
const RETRY_WHEN_AN_UPLOAD_ENDS: u32 = 30;

/// What handlers return.
pub(crate) type ApiResult<T = Response> = Result<T, ProblemResponse>;

/// The error type of every handler: a problem and the headers that go with it.
#[derive(Debug, Clone)]
pub(crate) struct ProblemResponse {
    problem: Box<Problem>,
    headers: Vec<(HeaderName, HeaderValue)>,
}

/// Makes answers of a problem's type.
pub(super) trait Answer {
    /// An answer of this type; `detail` says what happened.
    fn because(self, detail: impl Into<String>) -> ProblemResponse;
}

impl Answer for ProblemType {
    fn because(self, detail: impl Into<String>) -> ProblemResponse {
        Problem::new(self, detail).into()
    }
}

impl ProblemResponse {
    /// The document.
    pub(super) fn into_problem(self) -> Problem {
        *self.problem
    }

    pub(super) fn with_status(mut self, status: StatusCode) -> Self {
        self.problem.status = status.as_u16();
        self
    }

    pub(super) fn with_header(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.push((name, value));
        self
    }

    /// 422 about one parameter or field.
    pub(super) fn parameter(name: &str, error: impl Display) -> Self {
        ProblemType::InvalidParameter.because(format!("{name}: {error}"))
    }

    /// 404 for an id that names no `what`.
    pub(super) fn not_found(kind: ProblemType, what: &str, id: impl Display) -> Self {
        kind.because(format!("there is no {what} '{}'", truncated(&id.to_string())))
    }

    pub(super) fn no_job(id: impl Display) -> Self {
        Self::not_found(ProblemType::JobNotFound, "job", id)
    }

    pub(super) fn no_scene(id: impl Display) -> Self {
        Self::not_found(ProblemType::SceneNotFound, "scene", id)
    }

    pub(super) fn no_project(id: impl Display) -> Self {
        Self::not_found(ProblemType::ProjectNotFound, "project", id)
    }

    pub(super) fn no_upload(id: impl Display) -> Self {
        Self::not_found(ProblemType::UploadNotFound, "upload", id)
    }

    /// 507 if the disk is full.
    pub(super) fn storage_full() -> Self {
        ProblemType::StorageFull.because(
            "the server's disk has no room left, and nothing was kept; try again when the operator has made some",
        )
    }

    /// 409 for a file that only a succeeded job has.
    pub(super) fn no_file_yet(id: JobId, state: &str) -> Self {
        ProblemType::NoArtifact.because(format!("job {id} is {state}; only a succeeded job has a file"))
    }

    /// 413 with the limit.
    pub(super) fn too_large(limit: u64) -> Self {
        let detail = format!("the body is longer than the limit of {limit} bytes");
        ProblemType::BodyTooLarge.because(detail)
    }

    /// 503 for what can be repeated soon.
    pub(super) fn busy(detail: &str) -> Self {
        ProblemType::Busy.because(detail)
    }

    /// 500 without particulars; `error` goes to the log.
    pub(super) fn internal(error: &(dyn Error + 'static)) -> Self {
        tracing::error!(error, "internal error: {error}");
        internal().into()
    }
}

/// The problem of every internal error.
pub(super) fn internal() -> Problem {
    let detail = "the server met an internal error; its log has the particulars under this request id";
    Problem::new(ProblemType::Internal, detail)
}

/// The problem for an error answer without one: the framework's own 404, 405 and the like.
pub(super) fn plain(status: StatusCode, method: &str, path: &str) -> Problem {
    let path = truncated(path);
    let (kind, detail) = match status {
        StatusCode::NOT_FOUND => {
            (ProblemType::NotFound, format!("there is nothing at {path}; /openapi.yaml lists the operations"))
        }
        StatusCode::METHOD_NOT_ALLOWED => (
            ProblemType::MethodNotAllowed,
            format!("{path} does not take {method}; the Allow header lists the methods"),
        ),
        status if status.is_server_error() => return internal(),
        _ => (ProblemType::Refused, format!("{method} {path} was refused")),
    };
    Problem::new(kind, detail).with_status(status.as_u16())
}

/// A client's text, short enough to be repeated.
fn truncated(text: &str) -> String {
    match text.char_indices().nth(200) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

impl From<Problem> for ProblemResponse {
    fn from(problem: Problem) -> Self {
        Self { problem: Box::new(problem), headers: Vec::new() }
    }
}

/// Errors that are always internal.
macro_rules! internal_errors {
    ($($error:ty),*) => {
        $(impl From<$error> for ProblemResponse {
            fn from(error: $error) -> Self {
                Self::internal(&error)
            }
        })*
    };
}

internal_errors!(InvalidHeaderValue, JoinError, AcquireError);

impl From<StoreError> for ProblemResponse {
    fn from(error: StoreError) -> Self {
        if error.is_disk_full() {
            tracing::error!(error = &error as &dyn Error, "no room left for the database: {error}");
            return Self::storage_full();
        }
        if error.is_transient() {
            tracing::warn!(error = &error as &dyn Error, "the database is busy: {error}");
            return Self::busy("the database is busy");
        }
        match error {
            StoreError::QuotaExceeded { .. } => {
                let detail = format!("{error}; delete scenes, uploads or jobs to make room");
                ProblemType::QuotaExceeded.because(detail)
            }
            StoreError::TooManyJobs { .. } => {
                let detail = format!("{error}; wait until one has ended, or cancel one");
                ProblemType::TooManyJobs
                    .because(detail)
                    .with_header(header::RETRY_AFTER, RETRY_WHEN_A_JOB_ENDS.into())
            }
            StoreError::TooManyUploads { .. } => {
                let detail = format!("{error}; finish or delete one");
                ProblemType::TooManyUploads
                    .because(detail)
                    .with_header(header::RETRY_AFTER, RETRY_WHEN_AN_UPLOAD_ENDS.into())
            }
            StoreError::NoWorker { best: Preparation::None, .. } => ProblemType::PosesUnavailable.because(
                "the dataset has no cameras, and no worker of this service can find them: install pycolmap for one (`make poses`) \
                 and name its Python in TCGS_POSES_PYTHON if the service runs as another user, or send cameras with the photographs",
            ),
            StoreError::NoWorker { .. } => ProblemType::VideoUnavailable.because(
                "no worker of this service can read videos: install ffmpeg for one, or send photographs",
            ),
            StoreError::NoDataset(id) => Self::no_scene(id),
            StoreError::NoProject(id) => Self::no_project(id),
            StoreError::PriorityTooHigh { .. } => Self::parameter("priority", error),
            error => Self::internal(&error),
        }
    }
}

impl From<BlobError> for ProblemResponse {
    fn from(error: BlobError) -> Self {
        match error {
            BlobError::TooLarge { limit } => Self::too_large(limit),
            BlobError::Index(error) => error.into(),
            BlobError::Bucket(_) => {
                tracing::error!(error = &error as &dyn Error, "{error}");
                Self::busy("the service's bucket does not answer, or refuses")
            }
            error if error.is_disk_full() => {
                tracing::error!(error = &error as &dyn Error, "no room left: {error}");
                Self::storage_full()
            }
            error => Self::internal(&error),
        }
    }
}

impl IntoResponse for ProblemResponse {
    /// The problem rides along as an extension; [`super::server::middleware`] writes the body, once it knows the request id. Every 503 has
    /// `Retry-After`, also that of a renderer that lost its device.
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.problem.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = status.into_response();
        response.headers_mut().extend(self.headers);
        if status == StatusCode::SERVICE_UNAVAILABLE {
            response.headers_mut().entry(header::RETRY_AFTER).or_insert_with(|| RETRY_AFTER_SECONDS.into());
        }
        response.extensions_mut().insert(*self.problem);
        response
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;
    use crate::domain::DatasetId;

    #[test]
    fn only_the_beginning_of_a_long_path_is_repeated() {
        let long = "/x".repeat(4000);
        for status in [StatusCode::NOT_FOUND, StatusCode::METHOD_NOT_ALLOWED, StatusCode::IM_A_TEAPOT] {
            let detail = plain(status, "GET", &long).detail;
            assert!(detail.contains(&long[..200]) && detail.len() < 400, "{detail}");
        }
    }

    #[test]
    fn an_error_of_the_server_without_a_problem_is_an_internal_one() {
        assert_eq!(plain(StatusCode::BAD_GATEWAY, "GET", "/v1/jobs"), internal());
        assert_eq!(plain(StatusCode::IM_A_TEAPOT, "GET", "/v1/jobs").status, 418);
    }

    #[test]
    fn faults_of_the_store_that_a_client_can_do_something_about_are_not_internal() {
        let full = || io::Error::from(io::ErrorKind::StorageFull);
        let scene = DatasetId(uuid::Uuid::from_u128(1));
        let index = BlobError::Index(StoreError::of_a_silent_database());
        for (error, expected) in [
            (ProblemResponse::from(StoreError::NoDataset(scene)), ProblemType::SceneNotFound),
            (BlobError::TooLarge { limit: 17 }.into(), ProblemType::BodyTooLarge),
            (index.into(), ProblemType::Busy),
            (BlobError::of_a_silent_bucket().into(), ProblemType::Busy),
            (BlobError::Io(full()).into(), ProblemType::StorageFull),
            (BlobError::Io(io::Error::other("damaged")).into(), ProblemType::Internal),
        ] {
            let Problem { kind, detail, .. } = error.into_problem();
            assert_eq!(kind, Problem::new(expected, "").kind, "{detail}");
        }
    }
}
