//! The end of a mapping as a future, for pages, which must not block.

use std::{
    future::poll_fn,
    sync::{Mutex, PoisonError},
    task::{Poll, Waker},
};

/// A mapping under way or ended, with or without success.
#[derive(Debug, Default)]
pub(super) struct Mapping(Mutex<State>);

#[derive(Debug, Default)]
enum State {
    #[default]
    UnderWay,
    Awaited(Waker),
    Ended,
}

impl Mapping {
    /// Notes the end and wakes who awaits it.
    pub(super) fn end(&self) {
        let before =
            std::mem::replace(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner), State::Ended);
        if let State::Awaited(waker) = before {
            waker.wake();
        }
    }

    /// Waits for the end.
    pub(super) async fn ended(&self) {
        poll_fn(|context| {
            let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            if matches!(*state, State::Ended) {
                return Poll::Ready(());
            }
            *state = State::Awaited(context.waker().clone());
            Poll::Pending
        })
        .await;
    }
}
