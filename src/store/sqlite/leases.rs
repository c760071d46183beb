//! Claims and renewals as [`LeaseWatch`] has to know of them, and the jobs whose leases have run out by it.

use std::sync::{MutexGuard, PoisonError};

use super::{SqliteStore, job_changes, queue};
use crate::{
    domain::JobId,
    store::{
        Claim, Heartbeat, Lease, StoreError, WorkerDeath,
        leases::{LeaseRow, LeaseWatch},
    },
};

impl SqliteStore {
    /// Looks at all leases, and returns those that have run out.
    async fn expired(&self) -> Result<Vec<(LeaseRow, WorkerDeath)>, StoreError> {
        let rows = queue::leases(&self.readers).await?;
        Ok(self.lease_watch().look(&rows, self.policy.lease, self.clock.elapsed()))
    }

    /// The lease of one job, if it has run out.
    pub(super) async fn expired_of(&self, job: JobId) -> Result<Vec<(LeaseRow, WorkerDeath)>, StoreError> {
        let mut expired = self.expired().await?;
        expired.retain(|(lease, _)| lease.job == job);
        Ok(expired)
    }

    pub(super) async fn claim_next(&self, worker: &str) -> Result<Option<(LeaseRow, Claim)>, StoreError> {
        let expired = self.expired().await?;
        if expired.is_empty() && !self.anything_due().await? {
            return Ok(None);
        }
        let (mut tx, now) = self.begin().await?;
        queue::reap(&mut tx, &self.policy, &expired, now).await?;
        job_changes::fail_expired(&mut tx, now).await?;
        let claimed = queue::claim(&mut tx, &self.policy, worker, now).await?;
        tx.commit().await?;
        Ok(claimed)
    }

    pub(super) async fn renew(&self, lease: &Lease) -> Result<(LeaseRow, Heartbeat), StoreError> {
        let (mut tx, now) = self.begin().await?;
        let renewed = queue::heartbeat(&mut tx, &self.policy, lease, now).await?;
        tx.commit().await?;
        Ok(renewed)
    }

    pub(super) async fn reap_expired(&self) -> Result<u64, StoreError> {
        let expired = self.expired().await?;
        if expired.is_empty() {
            return Ok(0);
        }
        let (mut tx, now) = self.begin().await?;
        let count = queue::reap(&mut tx, &self.policy, &expired, now).await?;
        tx.commit().await?;
        Ok(count)
    }

    /// The answer, once the watch knows of the lease that was given out or renewed. Where the database failed, workers may
    /// have been unable to renew theirs, so none of them is taken for silent on account of the time until now.
    pub(super) fn watched<T>(
        &self,
        done: Result<(Option<LeaseRow>, T), StoreError>,
    ) -> Result<T, StoreError> {
        match done {
            Ok((row, answer)) => {
                if let Some(row) = row {
                    self.lease_watch().renewed(row, self.clock.elapsed());
                }
                Ok(answer)
            }
            Err(error) => {
                if !matches!(error, StoreError::LeaseLost { .. }) {
                    self.lease_watch().forget();
                }
                Err(error)
            }
        }
    }

    fn lease_watch(&self) -> MutexGuard<'_, LeaseWatch> {
        self.leases.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
