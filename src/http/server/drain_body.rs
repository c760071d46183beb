//! Drains the unread part of a request's body before its response.
//!
//! Many clients read the response only after sending their whole body. If the connection closed before that, they would see a
//! broken connection instead of the reason. So the rest of the body is read and discarded first, within limits that are higher for
//! authenticated clients. A response before the end of the body closes the connection.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use axum::{
    body::{Body, BodyDataStream},
    extract::Request,
    http::{HeaderValue, StatusCode, header},
    middleware::Next,
    response::Response,
};
use futures_util::{StreamExt as _, stream};
use hyper::body::Body as _;
use tokio::time::timeout;

use crate::http::auth::Authenticated;

/// How much of a body is drained, and for how long.
struct DrainLimits {
    bytes: usize,
    time: Duration,
}

const AUTHENTICATED_LIMITS: DrainLimits = DrainLimits { bytes: 256 << 20, time: Duration::from_secs(10) };
const ANONYMOUS_LIMITS: DrainLimits = DrainLimits { bytes: 1 << 20, time: Duration::from_secs(1) };

/// A body that first the handler and then this middleware reads.
struct Shared {
    body: BodyDataStream,
    /// Whether the handler began to read.
    started: bool,
}

/// Drains the body before the response is sent.
pub(crate) async fn drain_unread(request: Request, next: Next) -> Response {
    if request.body().is_end_stream() {
        return next.run(request).await;
    }
    let waits = request.headers().contains_key(header::EXPECT);
    let (parts, body) = request.into_parts();
    let shared = Arc::new(Mutex::new(Shared { body: body.into_data_stream(), started: false }));
    let mut response = next.run(Request::from_parts(parts, lent(Arc::clone(&shared)))).await;
    // Otherwise something else still reads the body.
    let Some(Ok(rest)) = Arc::into_inner(shared).map(Mutex::into_inner) else { return response };
    // A client that waits for `100 Continue` has sent nothing and must not start; one that was too slow would be again.
    let hopeless = (waits && !rest.started) || response.status() == StatusCode::REQUEST_TIMEOUT;
    let limits = if response.extensions().get::<Authenticated>().is_some() {
        AUTHENTICATED_LIMITS
    } else {
        ANONYMOUS_LIMITS
    };
    if hopeless || !limits.drain(rest.body).await {
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

fn lent(shared: Arc<Mutex<Shared>>) -> Body {
    Body::from_stream(stream::poll_fn(move |context| {
        let mut shared = shared.lock().unwrap_or_else(PoisonError::into_inner);
        shared.started = true;
        shared.body.poll_next_unpin(context)
    }))
}

impl DrainLimits {
    /// Whether the body came to its end.
    async fn drain(&self, mut body: BodyDataStream) -> bool {
        let read = async {
            let mut left = self.bytes;
            loop {
                match body.next().await {
                    None => return true,
                    Some(Err(_)) => return false,
                    Some(Ok(piece)) if piece.len() > left => return false,
                    Some(Ok(piece)) => left -= piece.len(),
                }
            }
        };
        timeout(self.time, read).await.unwrap_or(false)
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    /// A body of whole MiB and bytes, of which one piece is in memory.
    fn body(mebibytes: usize, more: usize) -> BodyDataStream {
        let piece = Bytes::from(vec![0; 1 << 20]);
        let rest = piece.slice(..more);
        let pieces = std::iter::repeat_n(piece, mebibytes).chain((more > 0).then_some(rest));
        Body::from_stream(stream::iter(pieces.map(Ok::<_, std::io::Error>))).into_data_stream()
    }

    #[tokio::test]
    async fn as_much_is_read_on_as_the_contract_says() {
        let contract = include_str!("../../../openapi.yaml").split_whitespace().collect::<Vec<_>>().join(" ");
        for (limits, mebibytes, seconds) in [(AUTHENTICATED_LIMITS, 256, 10), (ANONYMOUS_LIMITS, 1, 1)] {
            let said = format!("up to {mebibytes} MiB for {seconds} s");
            assert!(contract.contains(&said), "{said}");
            assert_eq!(limits.time, Duration::from_secs(seconds));
            assert!(limits.drain(body(mebibytes, 0)).await, "to its end");
            assert!(!limits.drain(body(mebibytes, 1)).await, "and no further");
        }
    }

    #[tokio::test]
    async fn what_does_not_come_or_breaks_off_is_not_waited_for() {
        let limits = DrainLimits { bytes: 1 << 20, time: Duration::from_millis(20) };
        let endless = Body::from_stream(stream::pending::<Result<Bytes, std::io::Error>>());
        assert!(!limits.drain(endless.into_data_stream()).await);
        let broken = stream::iter([Err::<Bytes, _>(std::io::Error::other("as the test wants it"))]);
        assert!(!AUTHENTICATED_LIMITS.drain(Body::from_stream(broken).into_data_stream()).await);
    }
}
