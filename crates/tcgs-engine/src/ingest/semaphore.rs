//! A counting semaphore with weights and timeouts, for memory and for checks that run at a time.

use std::{
    sync::{Condvar, Mutex, PoisonError},
    time::Duration,
};

/// A counting semaphore: units that several threads may hold together, such as bytes.
#[derive(Debug)]
pub(super) struct Semaphore {
    capacity: u64,
    state: Mutex<State>,
    freed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    held: u64,
    peak: u64,
}

/// Units that are held until this is dropped.
#[derive(Debug)]
pub(super) struct SemaphoreGuard<'a> {
    semaphore: &'a Semaphore,
    units: u64,
}

impl Semaphore {
    /// None is held yet.
    pub(super) fn new(capacity: u64) -> Self {
        Self { capacity, state: Mutex::default(), freed: Condvar::new() }
    }

    /// Waits until `units` are free. A request above the capacity waits for all of it.
    pub(super) fn acquire(&self, units: u64) -> SemaphoreGuard<'_> {
        let units = units.min(self.capacity);
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let mut state = self
            .freed
            .wait_while(state, |state| self.capacity - state.held < units)
            .unwrap_or_else(PoisonError::into_inner);
        state.hold(units);
        SemaphoreGuard { semaphore: self, units }
    }

    /// Waits at most `time` until `units` are free; `None` if they are not.
    pub(super) fn acquire_within(&self, units: u64, time: Duration) -> Option<SemaphoreGuard<'_>> {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut state, timeout) = self
            .freed
            .wait_timeout_while(state, time, |state| self.capacity - state.held < units)
            .unwrap_or_else(PoisonError::into_inner);
        (!timeout.timed_out()).then(|| {
            state.hold(units);
            SemaphoreGuard { semaphore: self, units }
        })
    }

    /// Holds `units` more from now on, if they are free.
    pub(super) fn try_keep(&self, units: u64) -> bool {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let free = self.capacity - state.held >= units;
        if free {
            state.hold(units);
        }
        free
    }

    /// Most units that were held at a time.
    #[cfg(test)]
    pub(super) fn peak(&self) -> u64 {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).peak
    }
}

impl State {
    fn hold(&mut self, units: u64) {
        self.held += units;
        self.peak = self.peak.max(self.held);
    }
}

impl Drop for SemaphoreGuard<'_> {
    fn drop(&mut self) {
        self.semaphore.state.lock().unwrap_or_else(PoisonError::into_inner).held -= self.units;
        self.semaphore.freed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_never_hold_more_than_there_is_and_all_get_their_turn() {
        let semaphore = Semaphore::new(10);
        std::thread::scope(|scope| {
            for thread in 0..8_u64 {
                let semaphore = &semaphore;
                scope.spawn(move || {
                    for round in 0..50 {
                        let guard = semaphore.acquire(1 + (thread * 7 + round) % 14);
                        std::thread::yield_now();
                        drop(guard);
                    }
                });
            }
        });
        assert_eq!(semaphore.peak(), 10, "some asked for more than all and got all");
        assert!(semaphore.try_keep(10), "everything was given back");
        assert!(!semaphore.try_keep(1) && semaphore.try_keep(0));
    }
}
