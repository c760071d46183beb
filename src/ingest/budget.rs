//! The memory that loading a dataset may take, and the semaphore that shares it among threads.

use std::{
    path::PathBuf,
    sync::{Condvar, Mutex, PoisonError},
};

/// Memory and temporary folder for decoded photographs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoadBudget {
    /// Bytes of memory for photographs that are kept or being decoded.
    pub memory_bytes: u64,
    /// Folder of the temporary file for the others; it should be on a disk, not in memory.
    pub spill_dir: PathBuf,
}

impl Default for LoadBudget {
    /// 4 GiB, and the system's folder for temporary files.
    fn default() -> Self {
        Self { memory_bytes: 4 << 30, spill_dir: std::env::temp_dir() }
    }
}

/// Bytes that several threads may hold together.
#[derive(Debug)]
pub(super) struct ByteSemaphore {
    capacity: u64,
    state: Mutex<State>,
    freed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    held: u64,
    peak: u64,
}

/// Bytes that are held until this is dropped.
#[derive(Debug)]
pub(super) struct ByteGuard<'a> {
    semaphore: &'a ByteSemaphore,
    bytes: u64,
}

impl ByteSemaphore {
    /// None is held yet.
    pub(super) fn new(capacity: u64) -> Self {
        Self { capacity, state: Mutex::default(), freed: Condvar::new() }
    }

    /// Waits until `bytes` more are free. A request above the capacity waits for all of it.
    pub(super) fn acquire(&self, bytes: u64) -> ByteGuard<'_> {
        let bytes = bytes.min(self.capacity);
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let mut state = self
            .freed
            .wait_while(state, |state| self.capacity - state.held < bytes)
            .unwrap_or_else(PoisonError::into_inner);
        state.hold(bytes);
        ByteGuard { semaphore: self, bytes }
    }

    /// Holds `bytes` more from now on, if they are free.
    pub(super) fn try_keep(&self, bytes: u64) -> bool {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let free = self.capacity - state.held >= bytes;
        if free {
            state.hold(bytes);
        }
        free
    }

    /// Most bytes that were held at a time.
    #[cfg(test)]
    pub(super) fn peak(&self) -> u64 {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).peak
    }
}

impl State {
    fn hold(&mut self, bytes: u64) {
        self.held += bytes;
        self.peak = self.peak.max(self.held);
    }
}

impl Drop for ByteGuard<'_> {
    fn drop(&mut self) {
        self.semaphore.state.lock().unwrap_or_else(PoisonError::into_inner).held -= self.bytes;
        self.semaphore.freed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_never_hold_more_than_there_is_and_all_get_their_turn() {
        let semaphore = ByteSemaphore::new(10);
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
