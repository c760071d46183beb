//! A job's history as a stream of server-sent events, from any event number to the job's end.
//!
//! Invariants: every event is sent once and in order by any server, since events are numbered per job; at most one page of events is
//! in memory, and the next is read only once the client has read it; the stream ends after the job's last event, when the
//! server stops, and, after a `closed` event, soon after the caller's key is revoked.

use std::{collections::VecDeque, convert::Infallible, time::Duration};

use axum::{
    http::{HeaderName, HeaderValue, header},
    response::{
        IntoResponse as _, Response,
        sse::{self, KeepAlive, Sse},
    },
};
use futures_util::{Stream, StreamExt as _, stream};

use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::{
    domain::{Caller, Credential, Event, EventKind, JobId, JobState, ProblemType},
    http::{
        auth::revocation::revoked,
        meters::GaugeGuard,
        problem::{Answer as _, ApiResult},
        shared::Slot,
        state::AppState,
    },
};

/// Events read at a time.
const PAGE: u32 = 100;
/// `Retry-After` where too many streams are open.
const STREAM_RETRY_SECONDS: u32 = 10;
/// The pause before a client reconnects.
const RETRY: Duration = Duration::from_millis(3000);
/// Tells nginx and similar proxies not to buffer.
const X_ACCEL_BUFFERING: HeaderName = HeaderName::from_static("x-accel-buffering");

/// A response with the events after number `after`.
pub(crate) fn answer(
    state: AppState,
    caller: &Caller,
    job: JobId,
    after: u64,
    slot: Slot<Credential>,
) -> Response {
    let counted = state.meters.stream_opened();
    let follower = Follower {
        state: state.clone(),
        job,
        after,
        page: VecDeque::new(),
        ended: false,
        _slot: slot,
        _counted: counted,
    };
    respond(state, caller.credential(), events(follower))
}

/// A place for a stream of this caller.
///
/// # Errors
/// 429 if all are taken, or all that one key or link may have.
pub(super) fn slot(state: &AppState, caller: &Caller) -> ApiResult<Slot<Credential>> {
    state.event_streams.take(caller.credential()).map_err(|taken| {
        let (count, of) = match taken.by_holder >= state.event_streams.capacity().each {
            true => (taken.by_holder, "of yours"),
            false => (taken.by_all, "in all"),
        };
        let detail = format!("{count} streams {of} are open, which is the limit; ask for pages instead");
        ProblemType::TooManyStreams
            .because(detail)
            .with_header(header::RETRY_AFTER, STREAM_RETRY_SECONDS.into())
    })
}

/// A response with these events, which ends with them or soon after the key or the link is revoked.
pub(super) fn respond(
    state: AppState,
    credential: Credential,
    events: impl Stream<Item = Result<sse::Event, Infallible>> + Send + 'static,
) -> Response {
    let keep_alive = KeepAlive::new().interval(state.limits.keep_alive).text("");
    let first = Ok(sse::Event::default().retry(RETRY));
    let shut_out = CancellationToken::new();
    let (watched, told) = (revoked(state, credential), shut_out.clone());
    let until_revoked = async move {
        watched.await;
        told.cancel();
    };
    let closing = stream::once(async move { shut_out.is_cancelled().then(|| Ok(closing(credential))) });
    let all = stream::once(async { first })
        .chain(events.take_until(until_revoked))
        .chain(closing.filter_map(std::future::ready));
    let headers = [
        (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
        (X_ACCEL_BUFFERING, HeaderValue::from_static("no")),
    ];
    (headers, Sse::new(all).keep_alive(keep_alive).into_response()).into_response()
}

fn events(follower: Follower) -> impl Stream<Item = Result<sse::Event, Infallible>> {
    stream::unfold(follower, |mut follower| async move {
        let event = follower.next().await?;
        Some((Ok(frame(&event)), follower))
    })
}

/// The last event of a stream that ends before the job. It has no number, since it is not part of the job's history.
fn closing(credential: Credential) -> sse::Event {
    let reason = match credential {
        Credential::Link(_) => "link-closed",
        Credential::Key(_) | Credential::None => "key-revoked",
    };
    sse::Event::default().event("closed").data(json!({ "reason": reason }).to_string())
}

fn frame(event: &Event) -> sse::Event {
    // An `Event` has string keys only, so writing it cannot fail; and JSON has no line breaks, so it is one line.
    let data = serde_json::to_string(event).unwrap_or_default();
    sse::Event::default().id(event.seq.to_string()).event(kind(event.kind)).data(data)
}

fn kind(kind: EventKind) -> &'static str {
    match kind {
        EventKind::State => "state",
        EventKind::Phase => "phase",
        EventKind::Progress => "progress",
        EventKind::Attempt => "attempt",
    }
}

/// A position in a job's history.
struct Follower {
    state: AppState,
    job: JobId,
    after: u64,
    page: VecDeque<Event>,
    ended: bool,
    _slot: Slot<Credential>,
    _counted: GaugeGuard,
}

impl Follower {
    /// The next event, once there is one.
    async fn next(&mut self) -> Option<Event> {
        let draining = self.state.draining.clone();
        while self.page.is_empty() && !self.ended {
            tokio::select! {
                // The client reconnects, to this server or another, and continues from there.
                () = draining.cancelled() => return None,
                () = self.read_on() => {}
            }
        }
        let event = self.page.pop_front().filter(|_| !draining.is_cancelled())?;
        self.after = event.seq;
        self.ended |= ends_the_job(&event);
        Some(event)
    }

    /// Reads a page, or waits until there is something to read.
    async fn read_on(&mut self) {
        match self.state.store().events(self.job, self.after, PAGE).await {
            Ok(Some(events)) if events.is_empty() => {
                // Deleted.
                self.ended = self.state.watcher.changed(self.job, self.after).await.is_none();
            }
            Ok(Some(events)) => self.page = events.into(),
            Ok(None) => self.ended = true,
            Err(error) => {
                let job = self.job;
                tracing::warn!(%job, error = &error as &dyn std::error::Error, "a stream ends early: {error}");
                self.ended = true;
            }
        }
    }
}

fn ends_the_job(event: &Event) -> bool {
    let state = event.data.get("state").and_then(|state| state.as_str()?.parse::<JobState>().ok());
    event.kind == EventKind::State && state.is_some_and(JobState::is_terminal)
}
