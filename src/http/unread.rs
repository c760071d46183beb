//! What of a request's body nobody read by the time of its answer.
//!
//! Many clients look for an answer only once they have sent their whole body. If the connection were closed before that, they
//! would see it break instead of the reason. So, whatever an operation answers and however early, the rest is read and thrown
//! away first: within bounds, and further for those who were let in. An answer before the end of its request's body says that
//! it is the connection's last.

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

/// On an answer, that `auth` let its request through.
#[derive(Debug, Clone, Copy)]
pub(super) struct LetIn;

/// How much of a body is read on, and how long.
struct Patience {
    bytes: usize,
    time: Duration,
}

const WITH_CALLERS: Patience = Patience { bytes: 256 << 20, time: Duration::from_secs(10) };
/// What is cheap.
const WITH_STRANGERS: Patience = Patience { bytes: 1 << 20, time: Duration::from_secs(1) };

/// A body that the handler and, after it, this layer read.
struct Shared {
    body: BodyDataStream,
    /// Whether the handler began to read.
    begun: bool,
}

/// Reads on before the answer goes out.
pub(super) async fn discard(request: Request, next: Next) -> Response {
    if request.body().is_end_stream() {
        return next.run(request).await;
    }
    let waits = request.headers().contains_key(header::EXPECT);
    let (parts, body) = request.into_parts();
    let shared = Arc::new(Mutex::new(Shared { body: body.into_data_stream(), begun: false }));
    let mut response = next.run(Request::from_parts(parts, lent(Arc::clone(&shared)))).await;
    // What still holds the body reads it.
    let Some(Ok(rest)) = Arc::into_inner(shared).map(Mutex::into_inner) else { return response };
    // A client that waits for `100 Continue` has sent nothing and must not be made to, and one that was too slow will be again.
    let hopeless = (waits && !rest.begun) || response.status() == StatusCode::REQUEST_TIMEOUT;
    let patience = if response.extensions().get::<LetIn>().is_some() { WITH_CALLERS } else { WITH_STRANGERS };
    if hopeless || !patience.exhaust(rest.body).await {
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

fn lent(shared: Arc<Mutex<Shared>>) -> Body {
    Body::from_stream(stream::poll_fn(move |context| {
        let mut shared = shared.lock().unwrap_or_else(PoisonError::into_inner);
        shared.begun = true;
        shared.body.poll_next_unpin(context)
    }))
}

impl Patience {
    /// Whether the body came to its end.
    async fn exhaust(&self, mut body: BodyDataStream) -> bool {
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

    /// A body of so many whole MiB and bytes, of which one piece is in memory.
    fn body(mebibytes: usize, more: usize) -> BodyDataStream {
        let piece = Bytes::from(vec![0; 1 << 20]);
        let rest = piece.slice(..more);
        let pieces = std::iter::repeat_n(piece, mebibytes).chain((more > 0).then_some(rest));
        Body::from_stream(stream::iter(pieces.map(Ok::<_, std::io::Error>))).into_data_stream()
    }

    #[tokio::test]
    async fn as_much_is_read_on_as_the_contract_says() {
        let contract = include_str!("../../openapi.yaml").split_whitespace().collect::<Vec<_>>().join(" ");
        for (patience, mebibytes, seconds) in [(WITH_CALLERS, 256, 10), (WITH_STRANGERS, 1, 1)] {
            let said = format!("up to {mebibytes} MiB for {seconds} s");
            assert!(contract.contains(&said), "{said}");
            assert_eq!(patience.time, Duration::from_secs(seconds));
            assert!(patience.exhaust(body(mebibytes, 0)).await, "to its end");
            assert!(!patience.exhaust(body(mebibytes, 1)).await, "and no further");
        }
    }

    #[tokio::test]
    async fn what_does_not_come_or_breaks_off_is_not_waited_for() {
        let patience = Patience { bytes: 1 << 20, time: Duration::from_millis(20) };
        let endless = Body::from_stream(stream::pending::<Result<Bytes, std::io::Error>>());
        assert!(!patience.exhaust(endless.into_data_stream()).await);
        let broken = stream::iter([Err::<Bytes, _>(std::io::Error::other("as the test wants it"))]);
        assert!(!WITH_CALLERS.exhaust(Body::from_stream(broken).into_data_stream()).await);
    }
}
