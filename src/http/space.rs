//! Room for what requests bring, reserved before a byte of it is stored: within the owner's quota, and above the floor of free space.
//!
//! What always holds: what this process is receiving counts against its owner's quota from before its first byte until something
//! refers to it, and, as far as it is not written yet, against the free space. Other processes do not know of it; there the
//! transaction that refers to the bytes has the last word, and bytes that it refuses are removed again.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use super::{problem::Fault, state::AppState};
use crate::domain::KeyId;

/// Bytes by which a reservation grows for a body that did not announce its length, where there is room for them.
const STEP: u64 = 8 << 20;

/// What is reserved in this process; clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct Space(Arc<Mutex<Pending>>);

#[derive(Debug, Default)]
struct Pending {
    by_owner: BTreeMap<Option<KeyId>, u64>,
    /// Bytes of all owners that are not on the disk yet.
    unwritten: u64,
}

/// Why there is no room.
#[derive(Debug)]
pub(super) enum Refusal {
    /// The owner's quota is used up. A dataset of theirs takes no further room; none of these is longer than `largest_dataset`.
    Quota { fault: Fault, largest_dataset: u64 },
    /// The disk has no room, or it cannot be told.
    Other(Fault),
}

impl From<Refusal> for Fault {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::Quota { fault, .. } | Refusal::Other(fault) => fault,
        }
    }
}

/// Room that is kept until this is dropped.
#[derive(Debug)]
pub(super) struct Reservation {
    space: Space,
    owner: Option<KeyId>,
    bytes: u64,
    written: u64,
}

impl Space {
    fn lock(&self) -> MutexGuard<'_, Pending> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reserves room for `bytes` of an owner's.
    ///
    /// # Errors
    /// [`Refusal`].
    pub(super) async fn reserve(
        state: &AppState,
        owner: Option<KeyId>,
        bytes: u64,
    ) -> Result<Reservation, Refusal> {
        let mut reservation = Reservation { space: state.space().clone(), owner, bytes: 0, written: 0 };
        reservation.grow(state, bytes).await?;
        Ok(reservation)
    }
}

/// Refuses `bytes` whose room is kept already, or what will need room of a size that nobody knows yet, where the disk has less than
/// that above the floor.
///
/// # Errors
/// 507.
pub(super) fn expect_above_floor(state: &AppState, bytes: u64) -> Result<(), Fault> {
    let needed = state.limits().min_free_space.saturating_add(bytes);
    if state.blobs().free_bytes()? < needed { Err(Fault::storage_full()) } else { Ok(()) }
}

impl Pending {
    fn expect_free(&self, free: u64, asked: u64) -> Result<(), Fault> {
        if self.unwritten.saturating_add(asked) > free { Err(Fault::storage_full()) } else { Ok(()) }
    }
}

/// Bytes that may still be written: those above the floor that no upload in parts is to have.
async fn free_bytes(state: &AppState) -> Result<u64, Fault> {
    let outstanding = state.store().outstanding_bytes().await?;
    let taken = outstanding.saturating_add(state.limits().min_free_space);
    state.blobs().free_bytes()?.checked_sub(taken).ok_or_else(Fault::storage_full)
}

impl Reservation {
    async fn grow(&mut self, state: &AppState, more: u64) -> Result<(), Refusal> {
        let room = state.store().capacity(self.owner).await.map_err(|error| Refusal::Other(error.into()))?;
        let free = free_bytes(state).await.map_err(Refusal::Other)?;
        let mut pending = self.space.lock();
        let own = pending.by_owner.get(&self.owner).copied().unwrap_or(0);
        room.admit(own, more)
            .map_err(|error| Refusal::Quota { fault: error.into(), largest_dataset: room.largest_dataset })?;
        pending.expect_free(free, more).map_err(Refusal::Other)?;
        pending.by_owner.insert(self.owner, own + more);
        pending.unwritten += more;
        drop(pending);
        self.bytes += more;
        Ok(())
    }

    /// Makes sure that `more` bytes can be written after those that were.
    ///
    /// # Errors
    /// [`Refusal`].
    pub(super) async fn cover(&mut self, state: &AppState, more: u64) -> Result<(), Refusal> {
        let needed = (self.written + more).saturating_sub(self.bytes);
        if needed == 0 {
            return Ok(());
        }
        if needed < STEP && self.grow(state, STEP).await.is_ok() {
            return Ok(());
        }
        self.grow(state, needed).await
    }

    /// Records that bytes are on the disk, where the system counts them.
    pub(super) fn wrote(&mut self, bytes: u64) {
        self.written += bytes;
        let mut pending = self.space.lock();
        pending.unwritten = pending.unwritten.saturating_sub(bytes);
    }

    /// Gives back what was not written.
    pub(super) fn settle(&mut self) {
        let spare = self.bytes - self.written;
        self.bytes = self.written;
        self.space.lock().release(self.owner, spare, spare);
    }
}

impl Pending {
    fn release(&mut self, owner: Option<KeyId>, bytes: u64, unwritten: u64) {
        self.unwritten = self.unwritten.saturating_sub(unwritten);
        if let Some(own) = self.by_owner.get_mut(&owner) {
            *own = own.saturating_sub(bytes);
            if *own == 0 {
                self.by_owner.remove(&owner);
            }
        }
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        let unwritten = self.bytes.saturating_sub(self.written);
        self.space.lock().release(self.owner, self.bytes, unwritten);
    }
}
