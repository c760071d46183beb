//! Requests that a page of another site has a browser send (cross-site request forgery).
//!
//! A browser sends them with whatever lets its user in: that it runs on this machine, where no key is asked for, or a key that it was
//! told as a password. It also says where they come from, in `Sec-Fetch-Site` or, an older one, in `Origin`. What a page of
//! another origin makes it ask is refused, but for following a link to here, which only shows the user something. A request with a
//! bearer's key is let through: browsers never add one by themselves.

use axum::http::{HeaderMap, Method, StatusCode};

use super::{
    host::{Hosts, only},
    problem::Fault,
};

/// A request that follows a link on another site's page. It is let in to look, and makes nothing that stays.
#[derive(Debug, Clone, Copy)]
pub(super) struct FollowedLink;

/// Whose doing a request is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Doing {
    /// The user's, a program's or a page's of this service.
    Own,
    /// The user's, who followed a link on a page of another site.
    FollowedLink,
}

/// 403 for what a page of another origin made a browser send.
pub(super) fn judge(method: &Method, headers: &HeaderMap, hosts: &Hosts) -> Result<Doing, Fault> {
    let site = only(headers, "sec-fetch-site");
    let origin = only(headers, "origin");
    match (site, origin) {
        (Some("same-origin" | "none"), _) => Ok(Doing::Own),
        (Some(_), _) if follows_link(method, headers) => Ok(Doing::FollowedLink),
        (Some(site), origin) => Err(refused(&format!(
            "Sec-Fetch-Site is {site}{}",
            origin.map_or_else(String::new, |origin| format!(" and Origin {origin}"))
        ))),
        (None, Some(origin)) if !hosts.serve_origin(origin) => Err(refused(&format!("Origin is {origin}"))),
        (None, _) => Ok(Doing::Own),
    }
}

/// Whether the answer becomes the page that a window or a tab shows.
fn follows_link(method: &Method, headers: &HeaderMap) -> bool {
    matches!(*method, Method::GET | Method::HEAD)
        && only(headers, "sec-fetch-mode") == Some("navigate")
        && only(headers, "sec-fetch-dest") == Some("document")
}

fn refused(why: &str) -> Fault {
    let why: String = why.chars().take(200).collect();
    let detail = format!(
        "a page of another origin made this request ({why}); the service answers its own pages, programs, and what is opened in a \
         window of its own"
    );
    Fault::new(StatusCode::FORBIDDEN, "cross-site-request", "Another site's request", detail)
}

/// 403 for a followed link to what would first have to be made.
pub(super) fn expect_own_doing(link: Option<&FollowedLink>) -> Result<(), Fault> {
    if link.is_none() {
        return Ok(());
    }
    let detail = "what this link leads to is not made yet, and a link on another site's page does not have it made; open it from here";
    Err(Fault::new(StatusCode::FORBIDDEN, "cross-site-request", "Another site's request", detail))
}

#[cfg(test)]
mod tests {
    use axum::{body::Body, extract::Request};

    use super::*;

    fn judged(method: &str, headers: &[(&str, &str)]) -> Option<Doing> {
        let mut request = Request::builder().method(method).uri("/v1/jobs").header("host", "localhost:8080");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let request = request.body(Body::empty()).expect("a request");
        let hosts = Hosts::of(&request).expect("a host");
        judge(request.method(), request.headers(), &hosts).ok()
    }

    #[test]
    fn only_own_requests_and_followed_links_are_let_through() {
        let link = [("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "document")];
        for method in ["GET", "HEAD", "POST", "DELETE", "PATCH", "OPTIONS"] {
            let reads = matches!(method, "GET" | "HEAD");
            assert_eq!(judged(method, &[]), Some(Doing::Own), "{method} by a program");
            for site in ["same-origin", "none"] {
                let from_here = [("sec-fetch-site", site), ("origin", "http://localhost:8080")];
                assert_eq!(judged(method, &from_here), Some(Doing::Own), "{method} {site}");
            }
            for site in ["cross-site", "same-site", "Same-Origin", ""] {
                let from = [("sec-fetch-site", site)];
                assert_eq!(judged(method, &from), None, "{method} {site}");
                let followed = reads.then_some(Doing::FollowedLink);
                assert_eq!(judged(method, &[&from[..], &link].concat()), followed, "{method} {site}");
                let framed = [from[0], link[0], ("sec-fetch-dest", "iframe")];
                assert_eq!(judged(method, &framed), None, "{method} {site}");
            }
            for origin in ["http://evil.example", "null", "http://localhost:3000", "https://localhost:8080/"]
            {
                assert_eq!(judged(method, &[("origin", origin)]), None, "{method} {origin}");
            }
            let twice = [("sec-fetch-site", "same-origin"), ("sec-fetch-site", "cross-site")];
            assert_eq!(judged(method, &twice), None, "{method}");
        }
    }
}
