//! `GET /v1/jobs/{id}/report`: everything that is known of a job on one page.
//!
//! What always holds: the page asks nothing of any other host, and of this one only what its viewer shows; it can be read
//! without scripts and printed; every text in it passes through a template that escapes it, and its content security policy
//! lets no script and no style run but its own two, which it names by their hashes.

mod bars;
mod chart;
mod curves;
mod history;
mod orbit;
mod page;
mod pictures;
mod settings;
mod units;

use std::sync::LazyLock;

use axum::{
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use base64::{Engine as _, engine::general_purpose::STANDARD};
use serde::de::DeserializeOwned;

use super::{
    accept::accepts,
    etag::{Etag, not_modified},
    jobs::find,
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, Digest, HeldOut, NamedCamera},
    store::{ArtifactKind, JobRecord},
};
use history::History;
use page::{Page, SCRIPT, STYLE};

/// Lets nothing in but the page's own script and style, pictures and the viewer's requests.
static POLICY: LazyLock<Option<HeaderValue>> = LazyLock::new(|| {
    let source = |text: &str| format!("'sha256-{}'", STANDARD.encode(Digest::of(text.as_bytes()).as_bytes()));
    let policy = format!(
        "default-src 'none'; script-src {}; style-src {}; img-src 'self' data: blob:; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        source(SCRIPT),
        source(STYLE)
    );
    HeaderValue::try_from(policy).ok()
});

/// Changes with the page's form, so that a newer program's page is not taken for an older one's.
const FORM: &str = env!("CARGO_PKG_VERSION");

/// `GET /v1/jobs/{id}/report`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
    headers: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    Parameters::parse(query.as_deref())?.finish()?;
    if !accepts(&headers, "text/html") {
        return Err(Fault::new(
            StatusCode::NOT_ACCEPTABLE,
            "not-acceptable",
            "Not acceptable",
            "reports are served as text/html",
        ));
    }
    let etag = Etag::new(format!("{}-{FORM}", record.job.version));
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    let history = History::read(state.store(), &record.job).await?;
    let held_out: Option<HeldOut> = document(&state, &record, ArtifactKind::HeldOut).await?;
    let cameras: Option<Vec<NamedCamera>> = document(&state, &record, ArtifactKind::Cameras).await?;
    let page = Page { record, history, held_out, cameras: cameras.unwrap_or_default() }.html().into_string();
    let policy = POLICY.clone().ok_or_else(super::problem::internal)?;
    let mut response = page.into_response();
    let answer = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_TYPE, HeaderValue::from_static("text/html; charset=utf-8")),
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache")),
        (header::ETAG, etag.value()),
        (header::REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
        (HeaderName::from_static("cross-origin-resource-policy"), HeaderValue::from_static("same-origin")),
    ] {
        answer.insert(name, value);
    }
    Ok(response)
}

/// What an artifact holds as JSON, if the job has one of its kind.
async fn document<T: DeserializeOwned>(
    state: &AppState,
    record: &JobRecord,
    kind: ArtifactKind,
) -> Result<Option<T>, Fault> {
    let Some(blob) = record.artifact(kind) else { return Ok(None) };
    let content = state.blobs().read(blob.digest).await?;
    serde_json::from_slice(&content).map(Some).map_err(|error| Fault::internal(&error))
}
