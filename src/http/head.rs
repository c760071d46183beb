//! Bounds on a request's head, well within what the connection's buffer bears, so that whoever exceeds them gets a problem
//! document. A head beyond the buffer is answered the bare status by hyper.

use axum::{
    extract::Request,
    http::StatusCode,
    middleware::Next,
    response::{IntoResponse as _, Response},
};

use super::problem::Fault;

/// Longest path with query, in bytes.
pub(super) const URI_BYTES: usize = 8 << 10;
/// Longest header section, in bytes.
pub(super) const HEADER_BYTES: usize = 32 << 10;

/// 414 or 431 for a head that is too long.
pub(super) async fn bounded(request: Request, next: Next) -> Response {
    let uri = request.uri().path_and_query().map_or(0, |uri| uri.as_str().len());
    if uri > URI_BYTES {
        let detail = format!("path and query are {uri} bytes long; {URI_BYTES} are possible");
        return Fault::new(StatusCode::URI_TOO_LONG, "uri-too-long", "URI too long", detail).into_response();
    }
    // As on the wire: name, colon, blank, value, line end.
    let headers = request.headers().iter().map(|(name, value)| name.as_str().len() + value.len() + 4);
    let headers: usize = headers.sum();
    if headers > HEADER_BYTES {
        let detail = format!("the headers are {headers} bytes long; {HEADER_BYTES} are possible");
        let status = StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE;
        return Fault::new(status, "headers-too-large", "Headers too large", detail).into_response();
    }
    next.run(request).await
}
