//! How much memory reading a dataset may take, and who waits when it is taken.

use std::{
    path::PathBuf,
    sync::{Condvar, Mutex, PoisonError},
};

/// Where decoded photographs may be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Room {
    /// Bytes of memory for those that are kept and those that are being decoded, together.
    pub memory: u64,
    /// Folder of the temporary file that takes the others; it should be on a disk, not in memory.
    pub spill: PathBuf,
}

impl Default for Room {
    /// 4 GiB, and the system's folder for temporary files.
    fn default() -> Self {
        Self { memory: 4 << 30, spill: std::env::temp_dir() }
    }
}

/// Bytes that several threads may hold together.
#[derive(Debug)]
pub(super) struct Permits {
    capacity: u64,
    state: Mutex<State>,
    freed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    held: u64,
    most: u64,
}

/// Bytes that are held until this is dropped.
#[derive(Debug)]
pub(super) struct Permit<'a> {
    permits: &'a Permits,
    bytes: u64,
}

impl Permits {
    /// None is held yet.
    pub(super) fn new(capacity: u64) -> Self {
        Self { capacity, state: Mutex::default(), freed: Condvar::new() }
    }

    /// Waits until `bytes` more are free. Whoever asks for more than there is, gets all of it.
    pub(super) fn take(&self, bytes: u64) -> Permit<'_> {
        let bytes = bytes.min(self.capacity);
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let mut state = self
            .freed
            .wait_while(state, |state| self.capacity - state.held < bytes)
            .unwrap_or_else(PoisonError::into_inner);
        state.hold(bytes);
        Permit { permits: self, bytes }
    }

    /// Holds `bytes` more from now on, if they are free.
    pub(super) fn keep(&self, bytes: u64) -> bool {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let free = self.capacity - state.held >= bytes;
        if free {
            state.hold(bytes);
        }
        free
    }

    /// Most bytes that were held at a time.
    #[cfg(test)]
    pub(super) fn most(&self) -> u64 {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).most
    }
}

impl State {
    fn hold(&mut self, bytes: u64) {
        self.held += bytes;
        self.most = self.most.max(self.held);
    }
}

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        self.permits.state.lock().unwrap_or_else(PoisonError::into_inner).held -= self.bytes;
        self.permits.freed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_never_hold_more_than_there_is_and_all_get_their_turn() {
        let permits = Permits::new(10);
        std::thread::scope(|scope| {
            for thread in 0..8_u64 {
                let permits = &permits;
                scope.spawn(move || {
                    for round in 0..50 {
                        let permit = permits.take(1 + (thread * 7 + round) % 14);
                        std::thread::yield_now();
                        drop(permit);
                    }
                });
            }
        });
        assert_eq!(permits.most(), 10, "some asked for more than all and got all");
        assert!(permits.keep(10), "everything was given back");
        assert!(!permits.keep(1) && permits.keep(0));
    }
}
