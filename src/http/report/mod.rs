//! `GET /v1/jobs/{id}/report`: everything about a job on one page, or its figures as comma-separated values.
//!
//! Invariants: the page requests nothing from other hosts, and from this one only pictures, events, links to share and itself; it can be read without
//! scripts and printed; every text is escaped by its template; its content security policy allows only its own script and style,
//! by their hashes.

mod bars;
mod csv;
mod curves;
mod history;
mod page;
mod pictures;
mod settings;
mod stages;
mod standing;
pub(super) mod units;

use axum::{
    extract::State,
    http::{HeaderMap, HeaderValue, header},
    response::{IntoResponse as _, Response},
};

use self::{
    history::History,
    page::{Page, STYLE, script},
};
use super::{
    auth::shared_link::OptionalLink,
    files::document,
    html,
    jobs::OwnedJob,
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{Etag, Parameters, accepts, not_modified},
    state::AppState,
};
use crate::{
    domain::{HeldOut, ProblemType},
    store::ArtifactKind,
};

/// The media types of a report.
const PAGE: &str = "text/html";
const TABLE: &str = "text/csv";

/// Version of the page's layout, part of its entity tag.
const FORM: &str = env!("CARGO_PKG_VERSION");

/// `GET /v1/jobs/{id}/report`.
pub(super) async fn get(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    link: OptionalLink,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let is_table = match parameters.take("format").as_deref() {
        None => !accepts(&headers, PAGE) && accepts(&headers, TABLE),
        Some("html") => false,
        Some("csv") => true,
        Some(other) => {
            return Err(ProblemResponse::parameter("format", format!("'{other}' is not one of html, csv")));
        }
    };
    parameters.finish()?;
    let kind = if is_table { TABLE } else { PAGE };
    if !accepts(&headers, kind) {
        let detail = format!("this report is served as {kind}; format=html and format=csv choose");
        return Err(ProblemType::NotAcceptable.because(detail));
    }
    let etag = Etag::new(format!("{}-{FORM}{}", record.job.version, if is_table { "-csv" } else { "" }));
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    let history = History::read(state.store(), &record.job).await?;
    if is_table {
        return Ok(table(csv::table(&record, &history), &etag));
    }
    let held_out: Option<HeldOut> = document(&state, &record, ArtifactKind::HeldOut).await?;
    let policy = html::policy(script(&record.job).unwrap_or_default(), STYLE);
    let has_cameras = record.artifact(ArtifactKind::Cameras).is_some();
    let page = Page { record, history, held_out, has_cameras, link }.html();
    let mut response = html::page(page, policy)?;
    response.headers_mut().insert(header::ETAG, etag.value());
    Ok(response)
}

/// The answer with comma-separated values.
fn table(text: String, etag: &Etag) -> Response {
    let head = [
        (header::CONTENT_TYPE, HeaderValue::from_static("text/csv; charset=utf-8; header=present")),
        (header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache")),
        (header::ETAG, etag.value()),
    ];
    (head, text).into_response()
}
