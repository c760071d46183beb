//! Connects claims and renewals with [`LeaseWatch`], and ends the attempts whose leases it found to have expired.

use std::sync::{MutexGuard, PoisonError};

use super::{SqliteStore, job_changes, queue};
use crate::{
    domain::JobId,
    store::{
        Claim, StoreError, WorkerDeath,
        leases::{LeaseRow, LeaseWatch},
    },
};

impl SqliteStore {
    /// Compares all leases with the watch, and returns those that have expired.
    async fn expired(&self) -> Result<Vec<(LeaseRow, WorkerDeath)>, StoreError> {
        let rows = queue::leases(&self.readers).await?;
        Ok(self.lease_watch().observe(&rows, self.policy.lease, self.clock.elapsed()))
    }

    /// The lease of one job, if it has expired.
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
        self.write(async move |tx, now| {
            queue::reap(tx, &self.policy, &expired, now).await?;
            job_changes::fail_expired(tx, now).await?;
            queue::claim(tx, &self.policy, worker, now).await
        })
        .await
    }

    pub(super) async fn reap_expired(&self) -> Result<u64, StoreError> {
        let expired = self.expired().await?;
        if expired.is_empty() {
            return Ok(0);
        }
        self.write(async move |tx, now| queue::reap(tx, &self.policy, &expired, now).await).await
    }

    /// Passes a result on, after the watch has recorded the lease that was granted or renewed. If the database failed, workers may
    /// have been unable to renew their leases, so the watch starts counting anew.
    pub(super) fn track_lease<T>(
        &self,
        result: Result<(Option<LeaseRow>, T), StoreError>,
    ) -> Result<T, StoreError> {
        match result {
            Ok((row, value)) => {
                if let Some(row) = row {
                    self.lease_watch().renewed(row, self.clock.elapsed());
                }
                Ok(value)
            }
            Err(error) => {
                if !matches!(error, StoreError::LeaseLost { .. }) {
                    self.lease_watch().reset();
                }
                Err(error)
            }
        }
    }

    fn lease_watch(&self) -> MutexGuard<'_, LeaseWatch> {
        self.leases.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
