//! Reserves space for uploaded bytes before any is stored: within the project's quota, and above the floor of free disk space.
//!
//! Invariants: bytes that this process receives count against their project's quota from before the first one until something refers to
//! them, and, until they are written, against the free space. Other processes do not see reservations; there the transaction
//! that refers to the bytes decides, and bytes that it refuses are removed again. Bytes that the quota has already, such as those of an
//! upload, are reserved on the disk alone.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use crate::{
    domain::ProjectId,
    http::{
        problem::{ApiResult, ProblemResponse},
        state::AppState,
    },
};

/// Growth of a reservation for a body without an announced length, in bytes, if there is space for it.
const STEP: u64 = 8 << 20;

/// What is reserved in this process; clones share it.
#[derive(Debug, Clone, Default)]
pub(crate) struct Reservations(Arc<Mutex<Pending>>);

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
            ReservationError::Quota(fault) | ReservationError::Other(fault) => fault,
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

impl Reservations {
    fn lock(&self) -> MutexGuard<'_, Pending> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reserves `bytes` for a project.
    ///
    /// # Errors
    /// [`ReservationError`].
    pub(crate) async fn reserve(
        state: &AppState,
        project: ProjectId,
        bytes: u64,
    ) -> Result<Reservation, ReservationError> {
        let mut reservation =
            Reservation { reservations: state.reservations.clone(), project, bytes: 0, written: 0 };
        reservation.grow(state, bytes).await?;
        Ok(reservation)
    }

    /// Reserves `bytes` on the disk alone, for what counts against a quota already.
    ///
    /// # Errors
    /// 507 if there is no room for them.
    pub(crate) async fn reserve_disk(state: &AppState, bytes: u64) -> ApiResult<DiskReservation> {
        let free = free_bytes(state).await?;
        let reservations = state.reservations.clone();
        let mut pending = reservations.lock();
        pending.expect_free(free, bytes)?;
        pending.unwritten += bytes;
        drop(pending);
        Ok(DiskReservation { reservations, bytes })
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

/// Refuses a request if the disk has less than `bytes` above the floor; for bytes that are reserved already, or of unknown number.
///
/// # Errors
/// 507.
pub(crate) fn require_free_space(state: &AppState, bytes: u64) -> ApiResult<()> {
    let needed = state.limits.min_free_space.saturating_add(bytes);
    if state.blobs().free_bytes()? < needed { Err(ProblemResponse::storage_full()) } else { Ok(()) }
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

/// Bytes that may still be written: those above the floor that are not promised to resumable uploads, which fill the disk unless a
/// bucket takes their parts.
async fn free_bytes(state: &AppState) -> ApiResult<u64> {
    let outstanding = match state.blobs().shared_files() {
        None => state.store().outstanding_bytes().await?,
        Some(_) => 0,
    };
    let taken = outstanding.saturating_add(state.limits.min_free_space);
    state.blobs().free_bytes()?.checked_sub(taken).ok_or_else(ProblemResponse::storage_full)
}

impl Reservation {
    async fn grow(&mut self, state: &AppState, more: u64) -> Result<(), ReservationError> {
        let room = state
            .store()
            .capacity(self.project)
            .await
            .map_err(|error| ReservationError::Other(error.into()))?;
        let free = free_bytes(state).await.map_err(ReservationError::Other)?;
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
    pub(crate) async fn cover(&mut self, state: &AppState, more: u64) -> Result<(), ReservationError> {
        let needed = (self.written + more).saturating_sub(self.bytes);
        if needed == 0 {
            return Ok(());
        }
        if needed < STEP && self.grow(state, STEP).await.is_ok() {
            return Ok(());
        }
        self.grow(state, needed).await
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
    use std::{path::Path, sync::Arc};

    use tempfile::TempDir;
    use tokio_util::sync::CancellationToken;

    use super::*;
    use crate::{
        domain::{
            DatasetSummary, Digest, ExportedScene, JobId, NamedCamera, Problem, ProblemType, SceneFormat,
            SystemClock, SystemRandom, WorkerCounts, Workers,
        },
        engine::{SceneEngine, SceneSource},
        http::{Services, config::RequestLimits},
        render::{RenderViews, views::Viewable},
        store::{Blobs, QueuePolicy, Store},
    };

    /// Neither an engine nor workers.
    struct Neither;

    fn never<T>() -> Result<T, Problem> {
        Err(Problem::new(ProblemType::Internal, "not of this test"))
    }

    impl SceneEngine for Neither {
        fn check(&self, _: &Path) -> Result<DatasetSummary, Problem> {
            never()
        }

        fn load(&self, _: &[u8]) -> Result<Viewable, Problem> {
            never()
        }

        fn renderer(&self, _: Digest) -> Result<Arc<dyn RenderViews>, Problem> {
            never()
        }

        fn export(
            &self,
            _: SceneSource<'_>,
            _: SceneFormat,
            _: &[NamedCamera],
        ) -> Result<ExportedScene, Problem> {
            never()
        }

        fn viewers(&self) -> Option<usize> {
            None
        }
    }

    impl Workers for Neither {
        fn counts(&self) -> WorkerCounts {
            WorkerCounts { expected: 0, alive: 0 }
        }

        fn forget(&self, _: JobId) {}
    }

    async fn state() -> (TempDir, AppState) {
        let folder = tempfile::tempdir().expect("a folder");
        let clock = Arc::new(SystemClock);
        let path = folder.path().join("tcgs.db");
        let store = Store::open(&path, clock.clone(), QueuePolicy::default());
        let services = Services {
            store: Arc::new(store.await.expect("a database")),
            blobs: Blobs::open(folder.path()).expect("a blob store"),
            clock,
            entropy: Arc::new(SystemRandom),
            engine: Arc::new(Neither),
            workers: Arc::new(Neither),
        };
        let limits = RequestLimits { min_free_space: 1, ..RequestLimits::default() };
        (folder, AppState::new(services, limits, CancellationToken::new()))
    }

    /// Bytes that count against the project's quota, and those that are not on the disk yet.
    fn held(state: &AppState) -> (u64, u64) {
        let pending = state.reservations.lock();
        (pending.by_project.get(&ProjectId::DEFAULT).copied().unwrap_or(0), pending.unwritten)
    }

    #[tokio::test]
    async fn what_is_reserved_is_written_or_released_and_nothing_stays() {
        let (_folder, state) = state().await;
        let reserve = async |bytes| {
            Reservations::reserve(&state, ProjectId::DEFAULT, bytes).await.expect("there is room")
        };
        let other = reserve(50).await;
        let mut one = reserve(1000).await;
        assert_eq!(held(&state), (1050, 1050), "reservations of one project add up");
        one.wrote(400);
        assert_eq!(held(&state), (1050, 650), "what is written counts against the quota alone");
        one.cover(&state, 600).await.expect("reserved");
        assert_eq!(held(&state), (1050, 650));
        one.cover(&state, 700).await.expect("there is room");
        assert_eq!(held(&state), (1050 + STEP, 650 + STEP), "it grows by steps");
        one.wrote(700);
        one.settle();
        assert_eq!(held(&state), (1150, 50));
        one.cover(&state, 2 * STEP).await.expect("there is room");
        assert_eq!(held(&state), (1150 + 2 * STEP, 50 + 2 * STEP), "or by what is needed, if that is more");
        one.wrote(STEP);
        drop(one);
        assert_eq!(held(&state), (50, 50));
        drop(other);
        let on_disk = Reservations::reserve_disk(&state, 500).await.expect("there is room");
        assert_eq!(held(&state), (0, 500));
        drop(on_disk);
        assert_eq!(held(&state), (0, 0));
        assert!(state.reservations.lock().by_project.is_empty(), "projects without bytes take no memory");
    }

    #[tokio::test]
    async fn bytes_need_room_beside_those_that_are_still_to_be_written() {
        let pending = Pending { unwritten: 10, ..Pending::default() };
        assert!(pending.expect_free(30, 20).is_ok());
        assert!(pending.expect_free(30, 21).is_err());
        let (_folder, state) = state().await;
        assert!(require_free_space(&state, 0).is_ok());
        assert!(require_free_space(&state, u64::MAX).is_err());
        assert!(Reservations::reserve_disk(&state, u64::MAX).await.is_err());
    }
}
