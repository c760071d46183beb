//! Calls of the store that fail when told to.

use std::{collections::BTreeMap, io, sync::Mutex};

use tcgs::store::{StoreError, StoreFaults, StoreFuture};

/// How calls fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failing {
    /// Like a database that is busy.
    Busy,
    /// Like one that is gone.
    Gone,
    /// Like one on a full disk.
    Full,
    /// Like one on a disk with room for small changes only: no attempt can end.
    FullForEnds,
    /// Like one that answers on a full disk: it can be read, and nothing shows the fault but an attempt to write.
    FullForProbes,
    /// Like one that does not answer in time: what creates something has failed, and is done once the test says so.
    Late,
    /// As they do: the test itself has stopped the server of the database.
    Stopped,
}

/// Lets calls of a store fail, and counts them.
#[derive(Default)]
pub struct PlannedFaults {
    failing: Mutex<Option<Failing>>,
    /// Calls by method and whether they failed.
    calls: Mutex<BTreeMap<(&'static str, bool), u32>>,
    /// What is still to be done.
    late: Mutex<Vec<StoreFuture<'static, ()>>>,
}

impl PlannedFaults {
    /// From now on, every call fails so, or none does.
    pub fn set(&self, failing: Option<Failing>) {
        *self.failing.lock().expect("not poisoned") = failing;
    }

    fn failing(&self) -> Option<Failing> {
        *self.failing.lock().expect("not poisoned")
    }

    /// Whether calls fail by plan.
    pub fn is_failing(&self) -> bool {
        self.failing().is_some()
    }

    /// How often a method was called.
    pub fn calls(&self, method: &'static str) -> u32 {
        let calls = self.calls.lock().expect("not poisoned");
        [true, false].iter().filter_map(|failed| calls.get(&(method, *failed))).sum()
    }

    /// How many calls of a method failed by plan.
    pub fn failures(&self, method: &'static str) -> u32 {
        self.calls.lock().expect("not poisoned").get(&(method, true)).copied().unwrap_or(0)
    }

    /// Does what was given up by [`Failing::Late`].
    pub async fn catch_up(&self) {
        let late = std::mem::take(&mut *self.late.lock().expect("not poisoned"));
        for work in late {
            work.await.expect("created in the end");
        }
    }
}

impl StoreFaults for PlannedFaults {
    fn fault(&self, method: &'static str) -> Option<StoreError> {
        let error = self.failing().and_then(|failing| match (failing, method) {
            (Failing::Busy, _) => Some(sqlx::Error::PoolTimedOut),
            (Failing::Gone, _) => Some(sqlx::Error::PoolClosed),
            (Failing::Full, _) | (Failing::FullForEnds, "finish") | (Failing::FullForProbes, "probe") => {
                Some(sqlx::Error::Io(io::ErrorKind::StorageFull.into()))
            }
            (Failing::Late, "create_job" | "create_dataset" | "add_export") => {
                Some(sqlx::Error::Io(io::ErrorKind::TimedOut.into()))
            }
            (Failing::FullForEnds | Failing::FullForProbes | Failing::Late | Failing::Stopped, _) => None,
        });
        *self.calls.lock().expect("not poisoned").entry((method, error.is_some())).or_default() += 1;
        error.map(StoreError::Database)
    }

    fn failed_creation(&self, work: StoreFuture<'static, ()>) {
        if self.failing() == Some(Failing::Late) {
            self.late.lock().expect("not poisoned").push(work);
        }
    }
}
