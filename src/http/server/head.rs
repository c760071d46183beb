//! Limits on a request's head, well below the connection's buffer, so that exceeding them is answered with a problem document. A
//! head larger than the buffer is answered by hyper, with the bare status.

use axum::{
    extract::Request,
    middleware::Next,
    response::{IntoResponse as _, Response},
};

use crate::{domain::ProblemType, http::problem::Answer as _};

/// Longest path with query, in bytes.
pub(super) const URI_BYTES: usize = 8 << 10;
/// Longest header section, in bytes.
pub(super) const HEADER_BYTES: usize = 32 << 10;

/// 414 or 431 for a head that is too long.
pub(crate) async fn bounded(request: Request, next: Next) -> Response {
    let uri = request.uri().path_and_query().map_or(0, |uri| uri.as_str().len());
    if uri > URI_BYTES {
        let detail = format!("path and query are {uri} bytes long; {URI_BYTES} are possible");
        return ProblemType::UriTooLong.because(detail).into_response();
    }
    // As on the wire: name, colon, blank, value, line end.
    let headers = request.headers().iter().map(|(name, value)| name.as_str().len() + value.len() + 4);
    let headers: usize = headers.sum();
    if headers > HEADER_BYTES {
        let detail = format!("the headers are {headers} bytes long; {HEADER_BYTES} are possible");
        return ProblemType::HeadersTooLarge.because(detail).into_response();
    }
    next.run(request).await
}

#[cfg(test)]
mod tests {
    use axum::{Router, body::Body, middleware::from_fn};
    use tower::ServiceExt as _;

    use super::*;

    #[tokio::test]
    async fn the_longest_heads_are_taken_and_one_byte_more_is_not() {
        let app = Router::new().fallback(|| async {}).layer(from_fn(bounded));
        // Name, colon, blank and line end.
        let around = "x-long: \r\n".len();
        for (uri, headers, status) in [
            (URI_BYTES, HEADER_BYTES, 200),
            (URI_BYTES + 1, HEADER_BYTES, 414),
            (URI_BYTES, HEADER_BYTES + 1, 431),
        ] {
            let request = Request::get(format!("/?{}", "q".repeat(uri - 2)));
            let request = request.header("x-long", "v".repeat(headers - around));
            let request = request.body(Body::empty()).expect("a request");
            let answer = app.clone().oneshot(request).await.expect("an answer");
            assert_eq!(answer.status(), status, "{uri} and {headers} bytes");
        }
    }
}
