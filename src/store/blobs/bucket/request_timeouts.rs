//! How long a bucket may say nothing: none of these limits ends a request whose bytes flow.
//!
//! The HTTP client's own limit of pauses also counts the time in which a request is sent, so it would end every upload that takes longer.

use std::{
    future::Future,
    io,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use bytes::Bytes;
use http_body::{Body, Frame, SizeHint};
use object_store::{
    ClientOptions,
    client::{
        HttpClient, HttpConnector, HttpError, HttpErrorKind, HttpRequest, HttpResponse, HttpResponseBody,
        HttpService, ReqwestConnector,
    },
};
use tokio::time::{Sleep, sleep, timeout};

/// The limits.
#[derive(Debug, Clone, Copy)]
pub(super) struct RequestTimeouts {
    /// The longest pause in an answer, and before it once the request is sent.
    pub(super) silence: Duration,
    /// The slowest connection on which a request is sent to its end, in bytes per second.
    pub(super) slowest: u64,
    /// The longest that a server may take to make one object of its parts; Amazon's takes minutes for large ones.
    pub(super) assembly: Duration,
}

impl Default for RequestTimeouts {
    fn default() -> Self {
        Self { silence: Duration::from_secs(20), slowest: 32 << 10, assembly: Duration::from_secs(300) }
    }
}

impl RequestTimeouts {
    /// The longest time from the start of a request to the head of its answer.
    fn until_answer(&self, request: &HttpRequest) -> Duration {
        let sending = Duration::from_secs(request.body().content_length() as u64 / self.slowest.max(1));
        let is_completion = request.method().as_str() == "POST"
            && request.uri().query().is_some_and(|query| query.contains("uploadId="));
        sending + if is_completion { self.assembly } else { self.silence }
    }
}

/// Connects clients that keep the limits.
#[derive(Debug)]
pub(super) struct TimeoutConnector(pub(super) RequestTimeouts);

impl HttpConnector for TimeoutConnector {
    fn connect(&self, options: &ClientOptions) -> object_store::Result<HttpClient> {
        let client = ReqwestConnector::default().connect(options)?;
        Ok(HttpClient::new(TimeoutClient { client, timeouts: self.0 }))
    }
}

#[derive(Debug)]
struct TimeoutClient {
    client: HttpClient,
    timeouts: RequestTimeouts,
}

impl HttpService for TimeoutClient {
    fn call<'client, 'call>(
        &'client self,
        request: HttpRequest,
    ) -> Pin<Box<dyn Future<Output = Result<HttpResponse, HttpError>> + Send + 'call>>
    where
        'client: 'call,
        Self: 'call,
    {
        let limit = self.timeouts.until_answer(&request);
        Box::pin(async move {
            let answer = timeout(limit, self.client.execute(request)).await.map_err(|_| silent())??;
            let pause = self.timeouts.silence;
            Ok(answer.map(|body| HttpResponseBody::new(TimeoutBody { body, pause, end: None })))
        })
    }
}

fn silent() -> HttpError {
    HttpError::new(HttpErrorKind::Timeout, io::Error::from(io::ErrorKind::TimedOut))
}

/// The body of an answer, of which each piece comes within `pause` from when it is asked for.
#[derive(Debug)]
struct TimeoutBody {
    body: HttpResponseBody,
    pause: Duration,
    /// The end of a pause that has begun. One begins only when a piece is asked for: a slow reader is no silent bucket.
    end: Option<Pin<Box<Sleep>>>,
}

impl Body for TimeoutBody {
    type Data = Bytes;
    type Error = HttpError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, HttpError>>> {
        if let Poll::Ready(frame) = Pin::new(&mut self.body).poll_frame(context) {
            self.end = None;
            return Poll::Ready(frame);
        }
        let pause = self.pause;
        let end = self.end.get_or_insert_with(|| Box::pin(sleep(pause)));
        end.as_mut().poll(context).map(|()| Some(Err(silent())))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::sleep;

    use super::*;

    const TIMEOUTS: RequestTimeouts = RequestTimeouts {
        silence: Duration::from_millis(40),
        slowest: 1,
        assembly: Duration::from_secs(3600),
    };

    /// A server that answers once it has taken a request's bytes, at a millisecond each, and then sends pieces with a pause before each.
    #[derive(Debug)]
    struct SlowServer {
        pieces: u32,
        pause: Duration,
    }

    struct SlowBody {
        left: u32,
        pause: Duration,
        next: Pin<Box<Sleep>>,
    }

    impl Body for SlowBody {
        type Data = Bytes;
        type Error = HttpError;

        fn poll_frame(
            mut self: Pin<&mut Self>,
            context: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Bytes>, HttpError>>> {
            if self.left == 0 {
                return Poll::Ready(None);
            }
            std::task::ready!(self.next.as_mut().poll(context));
            self.left -= 1;
            self.next = Box::pin(sleep(self.pause));
            Poll::Ready(Some(Ok(Frame::data(Bytes::from_static(b"piece")))))
        }
    }

    impl HttpService for SlowServer {
        fn call<'client, 'call>(
            &'client self,
            request: HttpRequest,
        ) -> Pin<Box<dyn Future<Output = Result<HttpResponse, HttpError>> + Send + 'call>>
        where
            'client: 'call,
            Self: 'call,
        {
            Box::pin(async move {
                sleep(Duration::from_millis(request.body().content_length() as u64)).await;
                let next = Box::pin(sleep(self.pause));
                let body = SlowBody { left: self.pieces, pause: self.pause, next };
                Ok(HttpResponse::new(HttpResponseBody::new(body)))
            })
        }
    }

    fn client(pieces: u32, pause: Duration) -> HttpClient {
        let client = HttpClient::new(SlowServer { pieces, pause });
        HttpClient::new(TimeoutClient { client, timeouts: TIMEOUTS })
    }

    fn request(bytes: usize) -> HttpRequest {
        HttpRequest::new(vec![7; bytes].into())
    }

    #[tokio::test]
    async fn a_request_whose_bytes_flow_is_not_ended() {
        // Five times the longest pause, to send and to receive.
        let answer = client(20, Duration::from_millis(10)).execute(request(200)).await.expect("an answer");
        assert_eq!(answer.into_body().bytes().await.expect("whole").len(), 100);
    }

    #[tokio::test]
    async fn a_server_that_says_nothing_is_given_up() {
        let silent = client(2, Duration::from_secs(3600));
        let answer = silent.execute(request(0)).await.expect("an answer");
        let error = answer.into_body().bytes().await.expect_err("no piece comes");
        assert_eq!(error.kind(), HttpErrorKind::Timeout);
        let never = TimeoutClient {
            client: HttpClient::new(SlowServer { pieces: 0, pause: Duration::ZERO }),
            timeouts: RequestTimeouts { slowest: 1 << 20, ..TIMEOUTS },
        };
        let error = never.call(request(1 << 19)).await.expect_err("too slow");
        assert_eq!(error.kind(), HttpErrorKind::Timeout);
    }

    #[test]
    fn time_to_send_grows_with_the_bytes_and_parts_are_put_together_for_minutes() {
        let timeouts = RequestTimeouts::default();
        let part = timeouts.until_answer(&request(8 << 20));
        assert!(part > Duration::from_secs(8 * 32), "8 MiB at a quarter of a megabit a second: {part:?}");
        assert_eq!(timeouts.until_answer(&request(0)), timeouts.silence);
        let mut completion = request(1000);
        *completion.method_mut() = "POST".parse().expect("a method");
        *completion.uri_mut() = "/bucket/object?uploadId=1".parse().expect("an address");
        assert_eq!(timeouts.until_answer(&completion), timeouts.assembly);
    }
}
