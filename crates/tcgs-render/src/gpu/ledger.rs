//! Counts the bytes of a device's live buffers and enforces its budget.
//!
//! When a reservation is made, the sum of all live ones is at most the budget. The count is kept here because software drivers
//! report no shortage of memory: the process is killed.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use super::GpuError;
use crate::domain::Bytes;

/// Bytes in use, their peak, the number of reservations, and the budget.
#[derive(Debug)]
pub(super) struct Ledger {
    used: AtomicU64,
    peak: AtomicU64,
    made: AtomicU64,
    budget: AtomicU64,
}

/// Bytes that count as used until this is dropped.
#[derive(Debug)]
pub(super) struct Reservation {
    ledger: Arc<Ledger>,
    bytes: u64,
}

impl Ledger {
    pub(super) fn new() -> Self {
        Self {
            used: AtomicU64::new(0),
            peak: AtomicU64::new(0),
            made: AtomicU64::new(0),
            budget: AtomicU64::new(u64::MAX),
        }
    }

    /// Counts `bytes` more for what `label` names.
    ///
    /// # Errors
    /// [`GpuError::OverBudget`], and nothing is counted.
    pub(super) fn reserve(self: &Arc<Self>, label: &str, bytes: u64) -> Result<Reservation, GpuError> {
        let budget = self.budget();
        let more = |used: u64| used.checked_add(bytes).filter(|sum| *sum <= budget);
        match self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more) {
            Ok(before) => {
                self.peak.fetch_max(before + bytes, Ordering::Relaxed);
                self.made.fetch_add(1, Ordering::Relaxed);
                Ok(Reservation { ledger: Arc::clone(self), bytes })
            }
            Err(used) => Err(GpuError::OverBudget {
                label: label.to_owned(),
                bytes: Bytes(bytes),
                used: Bytes(used),
                budget: Bytes(budget),
            }),
        }
    }

    pub(super) fn used(&self) -> u64 {
        self.used.load(Ordering::Relaxed)
    }

    pub(super) fn peak(&self) -> u64 {
        self.peak.load(Ordering::Relaxed)
    }

    /// Reservations made so far.
    pub(super) fn made(&self) -> u64 {
        self.made.load(Ordering::Relaxed)
    }

    pub(super) fn budget(&self) -> u64 {
        self.budget.load(Ordering::Relaxed)
    }

    pub(super) fn set_budget(&self, bytes: u64) {
        self.budget.store(bytes, Ordering::Relaxed);
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.ledger.used.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_over_the_budget_is_refused_with_the_figures_and_takes_nothing() {
        let ledger = Arc::new(Ledger::new());
        ledger.set_budget(100);
        let first = ledger.reserve("rows", 60).expect("room");
        let error = ledger.reserve("gradients", 41).expect_err("one too many");
        assert_eq!(
            error.to_string(),
            "buffer 'gradients' needs 41 bytes; 60 bytes of the budget of 100 bytes on the device are in use"
        );
        assert!(ledger.reserve("wrap", u64::MAX).is_err());
        let second = ledger.reserve("gradients", 40).expect("exactly the rest");
        assert_eq!((ledger.used(), ledger.peak()), (100, 100));
        drop(first);
        drop(second);
        assert_eq!((ledger.used(), ledger.peak()), (0, 100));
    }
}
