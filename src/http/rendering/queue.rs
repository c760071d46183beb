//! Decides who renders when: a bounded queue for a few renders at a time, fair between callers.
//!
//! A request enters once and then waits for a permit for each of its pictures, so a long batch queues again after each picture,
//! behind requests that came meanwhile. Waiting callers are served round-robin. Invariants: at most [`QueueLimits::at_once`] permits
//! are out; a waiter that is dropped leaves the queue at once.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use axum::http::header;
use tokio::sync::oneshot;

use crate::{
    domain::{Credential, ProblemType},
    http::{
        problem::{Answer as _, ProblemResponse},
        shared::{Capacity, Slot, Slots},
    },
};

/// Assumed duration of a render before the first one.
const INITIAL_RENDER_TIME: Duration = Duration::from_millis(500);
/// Weight of a new duration in the moving average.
const MEAN_WEIGHT: f64 = 0.2;
/// Largest `Retry-After`, in seconds.
const MAX_RETRY_AFTER: f64 = 120.0;

/// The bounds of a [`RenderQueue`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct QueueLimits {
    /// Pictures rendered at a time.
    pub(crate) at_once: usize,
    /// Requests that render or wait.
    pub(crate) requests: Capacity,
    /// Streams, which stay for long and wait between pictures.
    pub(crate) streams: Capacity,
}

/// What enters the queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Admission {
    /// A request for this many pictures.
    Request(usize),
    Stream,
}

/// Why an [`Admission`] was refused, with the seconds after which to try again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum AdmissionError {
    /// All slots are taken.
    Full(Admission, u64),
    /// The caller has as many slots as it may.
    CallerLimit(Admission, u64),
}

impl From<AdmissionError> for ProblemResponse {
    fn from(error: AdmissionError) -> Self {
        let (kind, of, admission, seconds) = match error {
            AdmissionError::Full(admission, seconds) => (ProblemType::Busy, "", admission, seconds),
            AdmissionError::CallerLimit(admission, seconds) => {
                (ProblemType::TooManyViews, "of this caller's ", admission, seconds)
            }
        };
        let what = match admission {
            Admission::Request(_) => "views are waiting to be rendered",
            Admission::Stream => "streams of views are open",
        };
        kind.because(format!("too many {of}{what}")).with_header(header::RETRY_AFTER, seconds.into())
    }
}

/// The queue; clones share it.
#[derive(Debug, Clone)]
pub(crate) struct RenderQueue(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    at_once: usize,
    requests: Slots<Credential>,
    streams: Slots<Credential>,
    state: Mutex<QueueState>,
}

#[derive(Debug, Default)]
struct QueueState {
    /// Permits that are out.
    permits: usize,
    /// Pictures of admitted requests that have not asked for a permit yet.
    unstarted: usize,
    /// Callers with a waiter; the first is served next.
    callers: VecDeque<CallerQueue>,
    tickets: u64,
    mean_seconds: Option<f64>,
}

#[derive(Debug)]
struct CallerQueue {
    caller: Credential,
    waiting: VecDeque<(u64, oneshot::Sender<()>)>,
}

impl QueueState {
    fn waiting(&self) -> usize {
        self.callers.iter().map(|queue| queue.waiting.len()).sum()
    }

    fn wait(&mut self, caller: Credential) -> (u64, oneshot::Receiver<()>) {
        let (sender, receiver) = oneshot::channel();
        self.tickets += 1;
        let entry = (self.tickets, sender);
        match self.callers.iter_mut().find(|queue| queue.caller == caller) {
            Some(queue) => queue.waiting.push_back(entry),
            None => self.callers.push_back(CallerQueue { caller, waiting: [entry].into() }),
        }
        (self.tickets, receiver)
    }

    /// Removes a ticket; whether it was still waiting.
    fn remove(&mut self, caller: Credential, ticket: u64) -> bool {
        let Some(index) = self.callers.iter().position(|queue| queue.caller == caller) else { return false };
        let waiting = &mut self.callers[index].waiting;
        let before = waiting.len();
        waiting.retain(|(other, _)| *other != ticket);
        let found = waiting.len() < before;
        if waiting.is_empty() {
            self.callers.remove(index);
        }
        found
    }

    fn grant_permits(&mut self, at_once: usize) {
        while self.permits < at_once {
            let Some(mut queue) = self.callers.pop_front() else { return };
            let next = queue.waiting.pop_front();
            if !queue.waiting.is_empty() {
                self.callers.push_back(queue);
            }
            // A waiter that was dropped has left the queue, so the receiver is there.
            if next.is_some_and(|(_, sender)| sender.send(()).is_ok()) {
                self.permits += 1;
            }
        }
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, QueueState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn release_permit(&self, state: &mut QueueState) {
        state.permits -= 1;
        state.grant_permits(self.at_once);
    }

    /// Estimated seconds until all that was admitted is rendered.
    fn retry_after(&self) -> u64 {
        let state = self.state();
        let pictures = state.permits + state.waiting() + state.unstarted;
        let mean = state.mean_seconds.unwrap_or(INITIAL_RENDER_TIME.as_secs_f64());
        (pictures as f64 * mean / self.at_once as f64).ceil().clamp(1.0, MAX_RETRY_AFTER) as u64
    }
}

impl RenderQueue {
    /// An empty queue.
    pub(crate) fn new(limits: QueueLimits) -> Self {
        Self(Arc::new(Shared {
            at_once: limits.at_once.max(1),
            requests: Slots::new(limits.requests),
            streams: Slots::new(limits.streams),
            state: Mutex::default(),
        }))
    }

    /// How many pictures are rendered and how many wait for a permit.
    pub(crate) fn depth(&self) -> (usize, usize) {
        let state = self.0.state();
        (state.permits, state.waiting())
    }

    /// Admits a caller's request or stream.
    pub(crate) fn enter(
        &self,
        caller: Credential,
        admission: Admission,
    ) -> Result<QueueSlot, AdmissionError> {
        let (slots, unstarted) = match admission {
            Admission::Request(pictures) => (&self.0.requests, pictures),
            Admission::Stream => (&self.0.streams, 0),
        };
        let slot = slots.take(caller).map_err(|taken| {
            let error = if taken.by_all >= slots.capacity().all {
                AdmissionError::Full
            } else {
                AdmissionError::CallerLimit
            };
            error(admission, self.0.retry_after())
        })?;
        self.0.state().unstarted += unstarted;
        Ok(QueueSlot { shared: Arc::clone(&self.0), caller, unstarted: unstarted.into(), _slot: slot })
    }
}

/// An admitted request or stream; it leaves when this is dropped.
#[derive(Debug)]
pub(crate) struct QueueSlot {
    shared: Arc<Shared>,
    caller: Credential,
    unstarted: AtomicUsize,
    _slot: Slot<Credential>,
}

impl QueueSlot {
    /// Counts one of the request's pictures as started, with a permit or without.
    pub(crate) fn begin_picture(&self) {
        let one_less = |unstarted: usize| unstarted.checked_sub(1);
        if self.unstarted.fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_less).is_ok() {
            self.shared.state().unstarted -= 1;
        }
    }

    /// Waits for a permit to render one picture.
    pub(crate) async fn permit(&self) -> RenderPermit {
        let (ticket, granted) = {
            let mut state = self.shared.state();
            let entry = state.wait(self.caller);
            state.grant_permits(self.shared.at_once);
            entry
        };
        let waiter = Waiter { shared: Arc::clone(&self.shared), caller: self.caller, ticket, granted: false };
        // The sender stays in the queue until it is used.
        let _ = granted.await;
        waiter.granted()
    }
}

impl Drop for QueueSlot {
    fn drop(&mut self) {
        self.shared.state().unstarted -= *self.unstarted.get_mut();
    }
}

/// A ticket in the queue.
struct Waiter {
    shared: Arc<Shared>,
    caller: Credential,
    ticket: u64,
    granted: bool,
}

impl Waiter {
    fn granted(mut self) -> RenderPermit {
        self.granted = true;
        RenderPermit { shared: Arc::clone(&self.shared), since: Instant::now() }
    }
}

impl Drop for Waiter {
    fn drop(&mut self) {
        if self.granted {
            return;
        }
        let mut state = self.shared.state();
        if !state.remove(self.caller, self.ticket) {
            // The permit was granted while its waiter was being dropped.
            self.shared.release_permit(&mut state);
        }
    }
}

/// The right to render one picture; the next waiter's when this is dropped.
#[derive(Debug)]
pub(crate) struct RenderPermit {
    shared: Arc<Shared>,
    since: Instant,
}

impl Drop for RenderPermit {
    fn drop(&mut self) {
        let seconds = self.since.elapsed().as_secs_f64();
        let mut state = self.shared.state();
        state.mean_seconds =
            Some(state.mean_seconds.map_or(seconds, |mean| mean + MEAN_WEIGHT * (seconds - mean)));
        self.shared.release_permit(&mut state);
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt as _, future::LocalBoxFuture};
    use uuid::Uuid;

    use super::*;
    use crate::domain::KeyId;

    fn key(id: u128) -> Credential {
        Credential::Key(KeyId(Uuid::from_u128(id)))
    }

    fn queue(at_once: usize, all: usize, each: usize) -> RenderQueue {
        let capacity = Capacity { all, each };
        RenderQueue::new(QueueLimits { at_once, requests: capacity, streams: capacity })
    }

    /// Requested permits, polled once, so that they queue in this order.
    fn enqueue_all<'a>(slots: &'a [QueueSlot]) -> Vec<LocalBoxFuture<'a, RenderPermit>> {
        slots
            .iter()
            .map(|slot| {
                let mut permit = slot.permit().boxed_local();
                assert!(permit.as_mut().now_or_never().is_none(), "the permit is taken");
                permit
            })
            .collect()
    }

    #[test]
    fn callers_are_served_round_robin_whatever_each_has_requested() {
        let queue = queue(1, 10, 10);
        let first = queue.enter(key(9), Admission::Request(1)).expect("a slot");
        let mut running = first.permit().now_or_never();
        assert!(running.is_some());
        let callers = [1, 1, 1, 2, 3, 2];
        let slots: Vec<QueueSlot> =
            callers.iter().map(|id| queue.enter(key(*id), Admission::Request(1)).expect("a slot")).collect();
        let mut waiting: Vec<_> = enqueue_all(&slots).into_iter().map(Some).collect();
        let mut served = Vec::new();
        while served.len() < callers.len() {
            running = None;
            for (index, permit) in waiting.iter_mut().enumerate() {
                if let Some(future) = permit
                    && let Some(granted) = future.as_mut().now_or_never()
                {
                    assert!(running.is_none(), "one at a time");
                    running = Some(granted);
                    served.push(callers[index]);
                    *permit = None;
                }
            }
            assert!(running.is_some(), "somebody is served");
        }
        assert_eq!(served, [1, 2, 3, 1, 2, 1]);
    }

    #[test]
    fn all_and_each_caller_are_limited_and_get_a_retry_time() {
        let queue = queue(2, 3, 2);
        let enter = |id| queue.enter(key(id), Admission::Request(10));
        let kept = [enter(1).expect("a slot"), enter(1).expect("a slot")];
        assert!(
            matches!(enter(1), Err(AdmissionError::CallerLimit(_, 5))),
            "twenty pictures of half a second, two at a time"
        );
        let other = enter(2).expect("a slot");
        assert!(matches!(enter(3), Err(AdmissionError::Full(_, 8))));
        let _stream = queue.enter(key(1), Admission::Stream).expect("streams have slots of their own");
        drop(kept);
        enter(1).expect("a slot again");
        drop(other);
        assert_eq!(queue.0.state().unstarted, 0);
    }

    #[test]
    fn a_dropped_waiter_leaves_the_queue_and_its_permit_passes_on() {
        let queue = queue(1, 10, 10);
        let slots: Vec<QueueSlot> =
            (0..4).map(|id| queue.enter(key(id), Admission::Request(1)).expect("a slot")).collect();
        let running = slots[0].permit().now_or_never().expect("nobody else");
        let mut waiting = enqueue_all(&slots[1..]);
        drop(waiting.remove(0));
        drop(running);
        // The permit is granted to the second, which is dropped without taking it.
        drop(waiting.remove(0));
        let last = waiting.remove(0).now_or_never();
        assert!(last.is_some());
        drop(last);
        let state = queue.0.state();
        assert_eq!((state.permits, state.callers.len()), (0, 0));
        assert!(state.mean_seconds.is_some());
    }
}
