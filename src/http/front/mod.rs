//! `GET /`: the page for browsers, with the jobs and what makes new ones.
//!
//! Invariants: addresses are relative, so the page works below any path; it can be read without scripts; every text is escaped by its
//! template; everything that changes something goes through the API's own operations.

mod jobs;
mod new_scene;
mod page;

use std::sync::LazyLock;

use axum::{
    extract::State,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::IntoResponse as _,
};

use self::page::{Front, SCRIPT, STYLE};
use super::{
    auth::caller::OptionalCaller,
    html,
    problem::ApiResult,
    request::{Page, Parameters, cursor, parse_cursor, prefers},
    state::AppState,
};
use crate::store::{JobFilter, JobRecord, PageKey};

/// The page's content security policy.
static POLICY: LazyLock<Option<HeaderValue>> = LazyLock::new(|| html::policy(SCRIPT, STYLE));

/// `GET /`.
pub(super) async fn get(
    State(state): State<AppState>,
    OptionalCaller(caller): OptionalCaller,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    if !prefers(&headers, "text/html", "application/json") {
        // The same as for any path without an operation.
        return Ok(StatusCode::NOT_FOUND.into_response());
    }
    let page = Page::take(&mut parameters, |text| {
        let (created_at, id) = parse_cursor(text)?;
        Some(PageKey { created_at, id })
    })?;
    parameters.finish()?;
    let front = match caller {
        None => Front::SignIn,
        Some(caller) => {
            let filter = JobFilter { project: caller.visible_project(), ..JobFilter::default() };
            let mut jobs = state.store().jobs(&filter, page.after, page.to_read()).await?;
            let after = |last: &JobRecord| cursor(last.job.created_at, last.job.id);
            let next = page.cut(&mut jobs, ".", after);
            Front::Jobs { has_key: caller.key.is_some(), is_first: page.after.is_none(), jobs, next }
        }
    };
    let mut response = html::page(front.html(), POLICY.clone())?;
    response.headers_mut().insert(header::VARY, HeaderValue::from_static("accept"));
    Ok(response)
}
