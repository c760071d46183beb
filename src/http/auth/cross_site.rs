//! Cross-site request forgery: requests that another site's page makes a browser send.
//!
//! The browser sends them with its user's access: it runs on this machine, where no key is needed, or it adds a key that was entered as
//! a password. It also says where they come from, in `Sec-Fetch-Site` or, if it is older, in `Origin`. Requests from pages of other
//! origins are refused, except navigation by a link, which only shows something to the user, and pages of origins that the operator
//! allows. Requests with a bearer token pass: browsers never add one by themselves.

use axum::http::{HeaderMap, Method};

use super::host::{Hosts, only};
use crate::{
    domain::ProblemType,
    http::{
        origins::AllowedOrigins,
        problem::{Answer as _, ApiResult, ProblemResponse},
    },
};

/// Marks a request that follows a link on another site's page; it may read, and creates nothing.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FollowedLink;

/// Who caused a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RequestOrigin {
    /// The user, a program, a page of this service or of an allowed origin.
    Own,
    /// The user, by following a link on another site's page.
    FollowedLink,
}

/// 403 for a request that a page of another origin made a browser send.
pub(super) fn classify(
    method: &Method,
    headers: &HeaderMap,
    hosts: &Hosts,
    allowed: &AllowedOrigins,
) -> ApiResult<RequestOrigin> {
    let site = only(headers, "sec-fetch-site");
    let origin = only(headers, "origin");
    match (site, origin) {
        (Some("same-origin" | "none"), _) => Ok(RequestOrigin::Own),
        (Some(_), _) if follows_link(method, headers) => Ok(RequestOrigin::FollowedLink),
        (_, Some(origin)) if allowed.allow(origin) => Ok(RequestOrigin::Own),
        (Some(site), origin) => Err(refused(&format!(
            "Sec-Fetch-Site is {site}{}",
            origin.map_or_else(String::new, |origin| format!(" and Origin {origin}"))
        ))),
        (None, Some(origin)) if !hosts.serve_origin(origin) => Err(refused(&format!("Origin is {origin}"))),
        (None, _) => Ok(RequestOrigin::Own),
    }
}

/// Whether the response becomes the page of a window or tab.
fn follows_link(method: &Method, headers: &HeaderMap) -> bool {
    matches!(*method, Method::GET | Method::HEAD)
        && only(headers, "sec-fetch-mode") == Some("navigate")
        && only(headers, "sec-fetch-dest") == Some("document")
}

fn refused(why: &str) -> ProblemResponse {
    let why: String = why.chars().take(200).collect();
    let detail = format!(
        "a page of another origin made this request ({why}); the service answers its own pages, programs, and what is opened in a \
         window of its own"
    );
    ProblemType::CrossSiteRequest.because(detail)
}

/// 403 for a followed link to something that would have to be created first.
pub(crate) fn refuse_followed_link(link: Option<&FollowedLink>) -> ApiResult<()> {
    if link.is_none() {
        return Ok(());
    }
    let detail = "the target of this link has to be created first, which a link on another site's page cannot do; open it from the service's own page";
    Err(ProblemType::CrossSiteRequest.because(detail))
}

#[cfg(test)]
mod tests {
    use axum::{body::Body, extract::Request};

    use super::*;

    fn classified(method: &str, headers: &[(&str, &str)]) -> Option<RequestOrigin> {
        classified_with(&AllowedOrigins::default(), method, headers)
    }

    fn classified_with(
        allowed: &AllowedOrigins,
        method: &str,
        headers: &[(&str, &str)],
    ) -> Option<RequestOrigin> {
        let mut request = Request::builder().method(method).uri("/v1/jobs").header("host", "localhost:8080");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let request = request.body(Body::empty()).expect("a request");
        let hosts = Hosts::of(&request).expect("a host");
        classify(request.method(), request.headers(), &hosts, allowed).ok()
    }

    #[test]
    fn only_own_requests_and_followed_links_are_let_through() {
        let link = [("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "document")];
        for method in ["GET", "HEAD", "POST", "DELETE", "PATCH", "OPTIONS"] {
            let reads = matches!(method, "GET" | "HEAD");
            assert_eq!(classified(method, &[]), Some(RequestOrigin::Own), "{method} by a program");
            for site in ["same-origin", "none"] {
                let from_here = [("sec-fetch-site", site), ("origin", "http://localhost:8080")];
                assert_eq!(classified(method, &from_here), Some(RequestOrigin::Own), "{method} {site}");
            }
            for site in ["cross-site", "same-site", "Same-Origin", ""] {
                let from = [("sec-fetch-site", site)];
                assert_eq!(classified(method, &from), None, "{method} {site}");
                let followed = reads.then_some(RequestOrigin::FollowedLink);
                assert_eq!(classified(method, &[&from[..], &link].concat()), followed, "{method} {site}");
                let framed = [from[0], link[0], ("sec-fetch-dest", "iframe")];
                assert_eq!(classified(method, &framed), None, "{method} {site}");
            }
            for origin in ["http://evil.example", "null", "http://localhost:3000", "https://localhost:8080/"]
            {
                assert_eq!(classified(method, &[("origin", origin)]), None, "{method} {origin}");
            }
            let own = [("origin", "http://localhost:8080")];
            assert_eq!(classified(method, &own), Some(RequestOrigin::Own), "{method} by the service's page");
            let twice = [("sec-fetch-site", "same-origin"), ("sec-fetch-site", "cross-site")];
            assert_eq!(classified(method, &twice), None, "{method}");
        }
    }

    #[test]
    fn pages_of_allowed_origins_are_let_through() {
        let allowed = AllowedOrigins(vec!["https://app.example".parse().expect("an origin")]);
        let (site, own) = (("sec-fetch-site", "cross-site"), ("origin", "https://app.example"));
        for method in ["GET", "POST", "DELETE"] {
            for headers in [&[own][..], &[site, own]] {
                assert_eq!(classified_with(&allowed, method, headers), Some(RequestOrigin::Own), "{method}");
            }
            for headers in [&[site][..], &[site, ("origin", "https://evil.example")], &[site, own, own]] {
                assert_eq!(classified_with(&allowed, method, headers), None, "{method} {headers:?}");
            }
        }
    }
}
