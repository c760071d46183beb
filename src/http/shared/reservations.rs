//! Reserves space for uploaded bytes before any is stored: within the project's quota, and above the floor of free disk space.
//!
//! Invariants: bytes that this process receives count against their project's quota from before the first one until something refers to
//! them, and, until they are written, against the free space. Other processes do not see reservations; there the transaction
//! that refers to the bytes decides, and bytes that it refuses are removed again. Bytes that the quota has already, such as those of an
//! upload, are reserved on the disk alone.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use crate::{
    domain::ProjectId,
    http::problem::{ApiResult, ProblemResponse},
    store::{Blobs, Store},
};

/// Growth of a reservation for a body without an announced length, in bytes, if there is space for it.
const STEP: u64 = 8 << 20;

/// What is reserved in this process; clones share it.
#[derive(Clone)]
pub(crate) struct Reservations(Arc<Inner>);

struct Inner {
    store: Store,
    blobs: Blobs,
    /// The floor of free disk space, in bytes.
    min_free_space: u64,
    pending: Mutex<Pending>,
}

#[derive(Debug, Default)]
struct Pending {
    by_project: BTreeMap<ProjectId, u64>,
    /// Bytes of all projects that are not on the disk yet.
    unwritten: u64,
}

/// Why space cannot be reserved.
#[derive(Debug)]
pub(crate) enum ReservationError {
    /// The project's quota is used up. Datasets that the project has take no further space.
    Quota(ProblemResponse),
    /// The disk is full, or its free space cannot be read.
    Other(ProblemResponse),
}

impl From<ReservationError> for ProblemResponse {
    fn from(refusal: ReservationError) -> Self {
        match refusal {
            ReservationError::Quota(error) | ReservationError::Other(error) => error,
        }
    }
}

/// Space that is reserved until this is dropped.
#[derive(Debug)]
pub(crate) struct Reservation {
    reservations: Reservations,
    project: ProjectId,
    bytes: u64,
    written: u64,
}

impl fmt::Debug for Reservations {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Reservations").field(&self.lock()).finish()
    }
}

impl Reservations {
    /// Nothing reserved yet; the disk that has the blobs keeps `min_free_space` bytes.
    pub(crate) fn new(store: Store, blobs: Blobs, min_free_space: u64) -> Self {
        Self(Arc::new(Inner { store, blobs, min_free_space, pending: Mutex::default() }))
    }

    fn lock(&self) -> MutexGuard<'_, Pending> {
        self.0.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reserves `bytes` for a project.
    ///
    /// # Errors
    /// [`ReservationError`].
    pub(crate) async fn reserve(
        &self,
        project: ProjectId,
        bytes: u64,
    ) -> Result<Reservation, ReservationError> {
        let mut reservation = Reservation { reservations: self.clone(), project, bytes: 0, written: 0 };
        reservation.grow(bytes).await?;
        Ok(reservation)
    }

    /// Reserves `bytes` on the disk alone, for what counts against a quota already.
    ///
    /// # Errors
    /// 507 if there is no room for them.
    pub(crate) async fn reserve_disk(&self, bytes: u64) -> ApiResult<DiskReservation> {
        let free = self.free_bytes().await?;
        let mut pending = self.lock();
        pending.expect_free(free, bytes)?;
        pending.unwritten += bytes;
        drop(pending);
        Ok(DiskReservation { reservations: self.clone(), bytes })
    }

    /// Refuses a request if the disk has less than `bytes` above the floor; for bytes that are reserved already, or of unknown number.
    ///
    /// # Errors
    /// 507.
    pub(crate) fn require_free_space(&self, bytes: u64) -> ApiResult<()> {
        let needed = self.0.min_free_space.saturating_add(bytes);
        if self.0.blobs.free_bytes()? < needed { Err(ProblemResponse::storage_full()) } else { Ok(()) }
    }

    /// Bytes that may still be written: those above the floor that are not promised to resumable uploads, which fill the disk unless a
    /// bucket takes their parts.
    async fn free_bytes(&self) -> ApiResult<u64> {
        let Inner { store, blobs, min_free_space, .. } = &*self.0;
        let outstanding = match blobs.shared_files() {
            None => store.outstanding_bytes().await?,
            Some(_) => 0,
        };
        let taken = outstanding.saturating_add(*min_free_space);
        blobs.free_bytes()?.checked_sub(taken).ok_or_else(ProblemResponse::storage_full)
    }
}

/// Space on the disk that is reserved until this is dropped, once the bytes are written.
#[derive(Debug)]
pub(crate) struct DiskReservation {
    reservations: Reservations,
    bytes: u64,
}

impl Drop for DiskReservation {
    fn drop(&mut self) {
        let mut pending = self.reservations.lock();
        pending.unwritten = pending.unwritten.saturating_sub(self.bytes);
    }
}

impl Pending {
    fn expect_free(&self, free: u64, requested: u64) -> ApiResult<()> {
        if self.unwritten.saturating_add(requested) > free {
            Err(ProblemResponse::storage_full())
        } else {
            Ok(())
        }
    }
}

impl Reservation {
    async fn grow(&mut self, more: u64) -> Result<(), ReservationError> {
        let store = &self.reservations.0.store;
        let room =
            store.capacity(self.project).await.map_err(|error| ReservationError::Other(error.into()))?;
        let free = self.reservations.free_bytes().await.map_err(ReservationError::Other)?;
        let mut pending = self.reservations.lock();
        let own = pending.by_project.get(&self.project).copied().unwrap_or(0);
        room.admit(own, more).map_err(|error| ReservationError::Quota(error.into()))?;
        pending.expect_free(free, more).map_err(ReservationError::Other)?;
        pending.by_project.insert(self.project, own + more);
        pending.unwritten += more;
        drop(pending);
        self.bytes += more;
        Ok(())
    }

    /// Grows the reservation so that `more` bytes can be written.
    ///
    /// # Errors
    /// [`ReservationError`].
    pub(crate) async fn cover(&mut self, more: u64) -> Result<(), ReservationError> {
        let needed = (self.written + more).saturating_sub(self.bytes);
        if needed == 0 {
            return Ok(());
        }
        if needed < STEP && self.grow(STEP).await.is_ok() {
            return Ok(());
        }
        self.grow(needed).await
    }

    /// Records that bytes are on the disk, where they count as used space.
    pub(crate) fn wrote(&mut self, bytes: u64) {
        self.written += bytes;
        let mut pending = self.reservations.lock();
        pending.unwritten = pending.unwritten.saturating_sub(bytes);
    }

    /// Releases what was not written.
    pub(crate) fn settle(&mut self) {
        let spare = self.bytes - self.written;
        self.bytes = self.written;
        self.reservations.lock().release(self.project, spare, spare);
    }
}

impl Pending {
    fn release(&mut self, project: ProjectId, bytes: u64, unwritten: u64) {
        self.unwritten = self.unwritten.saturating_sub(unwritten);
        if let Some(own) = self.by_project.get_mut(&project) {
            *own = own.saturating_sub(bytes);
            if *own == 0 {
                self.by_project.remove(&project);
            }
        }
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        let unwritten = self.bytes.saturating_sub(self.written);
        self.reservations.lock().release(self.project, self.bytes, unwritten);
    }
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::*;
    use crate::{domain::SystemClock, store::QueuePolicy};

    async fn reservations() -> (TempDir, Reservations) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tcgs.db");
        let store = Store::open(&path, Arc::new(SystemClock), QueuePolicy::default());
        let store = store.await.expect("a database");
        let blobs = Blobs::open(folder.path()).expect("a blob store");
        (folder, Reservations::new(store, blobs, 1))
    }

    /// Bytes that count against the project's quota, and those that are not on the disk yet.
    fn held(reservations: &Reservations) -> (u64, u64) {
        let pending = reservations.lock();
        (pending.by_project.get(&ProjectId::DEFAULT).copied().unwrap_or(0), pending.unwritten)
    }

    #[tokio::test]
    async fn what_is_reserved_is_written_or_released_and_nothing_stays() {
        let (_folder, reservations) = reservations().await;
        let reserve =
            async |bytes| reservations.reserve(ProjectId::DEFAULT, bytes).await.expect("there is room");
        let other = reserve(50).await;
        let mut one = reserve(1000).await;
        assert_eq!(held(&reservations), (1050, 1050), "reservations of one project add up");
        one.wrote(400);
        assert_eq!(held(&reservations), (1050, 650), "what is written counts against the quota alone");
        one.cover(600).await.expect("reserved");
        assert_eq!(held(&reservations), (1050, 650));
        one.cover(700).await.expect("there is room");
        assert_eq!(held(&reservations), (1050 + STEP, 650 + STEP), "it grows by steps");
        one.wrote(700);
        one.settle();
        assert_eq!(held(&reservations), (1150, 50));
        one.cover(2 * STEP).await.expect("there is room");
        assert_eq!(
            held(&reservations),
            (1150 + 2 * STEP, 50 + 2 * STEP),
            "or by what is needed, if that is more"
        );
        one.wrote(STEP);
        drop(one);
        assert_eq!(held(&reservations), (50, 50));
        drop(other);
        let on_disk = reservations.reserve_disk(500).await.expect("there is room");
        assert_eq!(held(&reservations), (0, 500));
        drop(on_disk);
        assert_eq!(held(&reservations), (0, 0));
        assert!(reservations.lock().by_project.is_empty(), "projects without bytes take no memory");
    }

    #[tokio::test]
    async fn bytes_need_room_beside_those_that_are_still_to_be_written() {
        let pending = Pending { unwritten: 10, ..Pending::default() };
        assert!(pending.expect_free(30, 20).is_ok());
        assert!(pending.expect_free(30, 21).is_err());
        let (_folder, reservations) = reservations().await;
        assert!(reservations.require_free_space(0).is_ok());
        assert!(reservations.require_free_space(u64::MAX).is_err());
        assert!(reservations.reserve_disk(u64::MAX).await.is_err());
    }
}
