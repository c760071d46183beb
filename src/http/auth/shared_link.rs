//! Shared links: `/s/TOKEN/PATH` is `/PATH` for whoever has the link, as far as the link opens it.
//!
//! Invariants: a link opens reads of one job and nothing else; a link of a page alone opens what the page loads, and the page leads nowhere
//! else; the token is taken out of the path before routing, so no log has it.

use std::convert::Infallible;

use axum::{
    extract::{FromRequestParts, Request},
    http::{Method, Uri, request::Parts, uri::PathAndQuery},
};

use crate::{
    domain::{Caller, ProblemType, ShareToken},
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        state::AppState,
    },
};

/// What a link of a whole page opens: the page and what it shows.
const OPENED: [&str; 11] = [
    "/v1/jobs/{id}/report",
    "/v1/jobs/{id}/viewer",
    "/v1/jobs/{id}/view",
    "/v1/jobs/{id}/thumbnail",
    "/v1/jobs/{id}/preview",
    "/v1/jobs/{id}/events",
    "/v1/jobs/{id}/series",
    "/v1/jobs/{id}/artifact",
    "/v1/jobs/{id}/export",
    "/v1/jobs/{id}/stream",
    "/v1/jobs/{id}/animation",
];

/// Whether a link may be of this alone, as a path below the job without its query.
pub(crate) fn may_open(below: &str) -> bool {
    OPENED.iter().any(|route| route.strip_prefix("/v1/jobs/{id}/") == Some(below))
}

/// What a page loads as it is shown.
fn loads(page: &str) -> &'static [&'static str] {
    match (page, page.split('?').next()) {
        // Of an unfinished job.
        ("report" | "report?format=html", _) => &["events", "preview"],
        (_, Some("viewer")) => &["artifact", "view"],
        _ => &[],
    }
}

/// Whether a link of `target` alone opens this, both as path and query below the job.
fn is_opened_by(target: &str, below: &str) -> bool {
    if target == below {
        return true;
    }
    let weights = |path: &str| -> Vec<String> {
        let query = path.split_once('?').map_or("", |(_, query)| query);
        let all: Vec<(String, String)> = serde_urlencoded::from_str(query).unwrap_or_default();
        all.into_iter().filter(|(name, _)| name == "lambda").map(|(_, value)| value).collect()
    };
    let path = below.split('?').next().unwrap_or_default();
    // Of several files, the page of one opens no other.
    loads(target).contains(&path) && weights(target) == weights(below)
}

/// The address of something below a link.
pub(crate) fn prefix(token: &ShareToken) -> String {
    format!("/s/{}", token.expose())
}

/// The token of a request's path; `None` if it is none.
#[derive(Debug, Clone)]
pub(super) struct PathToken(Option<ShareToken>);

/// Takes the token of a link out of a request's path. Before routing.
pub(crate) fn take_token(mut request: Request) -> Request {
    let path = request.uri().path_and_query().map_or("/", PathAndQuery::as_str);
    let Some((token, rest)) = path.strip_prefix("/s/").and_then(|path| path.split_once('/')) else {
        return request;
    };
    let token = PathToken(token.parse().ok());
    let mut parts = request.uri().clone().into_parts();
    parts.path_and_query = format!("/{rest}").parse().ok();
    if let Ok(uri) = Uri::from_parts(parts) {
        *request.uri_mut() = uri;
        request.extensions_mut().insert(token);
    }
    request
}

/// The link by which a request came in, if it did; an extractor.
#[derive(Debug, Clone, Default)]
pub(crate) struct OptionalLink {
    /// What the paths of the service have before them in this link.
    pub(crate) prefix: Option<String>,
    /// The only thing that the link opens, as path and query below the job; `None` if it opens the whole page.
    pub(crate) target: Option<String>,
}

impl<S: Sync> FromRequestParts<S> for OptionalLink {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(parts.extensions.get().cloned().unwrap_or_default())
    }
}

/// What a request by a link asks for.
pub(super) struct LinkRequest {
    is_read: bool,
    route: Option<String>,
    /// Path and query.
    path: String,
}

impl LinkRequest {
    pub(super) fn of(request: &Request, route: Option<String>) -> Self {
        let path = request.uri().path_and_query().map_or("/", PathAndQuery::as_str);
        let is_read = matches!(*request.method(), Method::GET | Method::HEAD);
        Self { is_read, route, path: path.to_owned() }
    }
}

/// Who a link makes of its holder, for this request.
///
/// # Errors
/// 404 for whatever the link does not open, and for links that are over.
pub(super) async fn admit(
    state: &AppState,
    token: PathToken,
    request: LinkRequest,
) -> ApiResult<(Caller, OptionalLink)> {
    let token = token.0.ok_or_else(closed)?;
    let LinkRequest { is_read, route, path } = request;
    if !is_read || !route.is_some_and(|route| OPENED.contains(&&*route)) {
        return Err(closed());
    }
    if !state.share_secret().await?.has_signed(&token) {
        return Err(closed());
    }
    let share = state.store().share(token.id).await?.ok_or_else(closed)?;
    let below = path.strip_prefix(&format!("/v1/jobs/{}/", share.job)).ok_or_else(closed)?;
    if share.target.as_deref().is_some_and(|target| !is_opened_by(target, below)) {
        return Err(closed());
    }
    let caller = Caller { key: None, link: Some(share.id), project: share.project, admin: false };
    Ok((caller, OptionalLink { prefix: Some(prefix(&token)), target: share.target }))
}

fn closed() -> ProblemResponse {
    ProblemType::NotFound.because("the link does not open this, has expired, or was revoked")
}

#[cfg(test)]
mod tests {
    use axum::body::Body;

    use super::*;

    #[test]
    fn the_token_leaves_the_path_and_everything_else_stays() {
        let token = "0a".repeat(32);
        let taken = |path: &str| {
            let request = Request::builder().uri(path).body(Body::empty()).expect("a request");
            let request = take_token(request);
            let token = request.extensions().get::<PathToken>().map(|token| token.0.is_some());
            (request.uri().to_string(), token)
        };
        assert_eq!(
            taken(&format!("/s/{token}/v1/jobs/7/view?a=b%20c")),
            ("/v1/jobs/7/view?a=b%20c".into(), Some(true))
        );
        assert_eq!(taken("/s/17/v1/jobs"), ("/v1/jobs".into(), Some(false)), "it is no way to what is open");
        for other in ["/", "/v1/jobs", "/s", "/s/", "/session"] {
            assert_eq!(taken(other), (other.into(), None));
        }
        assert_eq!(taken(&format!("/s/{token}//evil.example/x")).0, "//evil.example/x");
    }

    #[test]
    fn a_link_of_a_page_alone_opens_what_the_page_loads() {
        for (target, below) in [
            ("artifact", "artifact"),
            ("viewer", "viewer"),
            ("viewer", "artifact"),
            ("viewer", "view?position=1,2,3&width=40"),
            ("viewer?lambda=0.002", "artifact?lambda=0.002"),
            ("viewer?lambda=0.002", "view?lambda=0.002&width=40"),
            ("report", "events?after=7"),
            ("report", "preview?of=photograph"),
        ] {
            assert!(is_opened_by(target, below), "{target} loads {below}");
        }
        for (target, below) in [
            ("artifact", "artifact?lambda=0.002"),
            ("artifact", "view"),
            ("viewer", "report"),
            ("viewer", "viewer?lambda=0.002"),
            ("viewer", "artifact?lambda=0.002"),
            ("viewer", "view?width=40&%6Cambda=0.002"),
            ("viewer?lambda=0.002", "artifact"),
            ("viewer?lambda=0.002", "view?lambda=0.02"),
            ("viewer?lambda=0.002", "view?lambda=0.002&lambda=0.02"),
            ("report", "artifact"),
            ("report?format=csv", "preview"),
        ] {
            assert!(!is_opened_by(target, below), "{target} does not load {below}");
        }
    }

    #[test]
    fn only_reads_of_a_job_can_be_shared() {
        assert!(may_open("artifact") && may_open("view"));
        for never in ["", "cancel", "artifacts", "shares", "../x", "view?x=1"] {
            assert!(!may_open(never), "{never}");
        }
    }
}
