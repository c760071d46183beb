//! Connects claims and renewals with [`LeaseWatch`], and ends the attempts whose leases it found to have expired.

use std::sync::{MutexGuard, PoisonError};

use super::{
    Store,
    queue::{self, Claiming},
};
use crate::{
    domain::{FailurePoint, JobId, Preparation, failure_point::reach},
    store::{
        Claim, StoreError, WorkerDeath,
        leases::{LeaseRow, LeaseWatch},
    },
};

impl Store {
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

    pub(super) async fn claim_next(
        &self,
        worker: &str,
        can: Preparation,
    ) -> Result<Option<(LeaseRow, Claim)>, StoreError> {
        let expired = self.expired().await?;
        if expired.is_empty() && !self.anything_due(can).await? {
            return Ok(None);
        }
        // Each in a transaction of its own: each locks the projects that it changes at once.
        self.reap(expired).await?;
        self.fail_overdue().await?;
        loop {
            let claimed = self.write(async move |tx, now| {
                let claimed = queue::claim(tx, &self.policy, worker, can, now).await?;
                if matches!(claimed, Claiming::Granted(_)) {
                    reach(FailurePoint::BeforeClaim);
                }
                Ok(claimed)
            });
            match claimed.await? {
                Claiming::Granted(claimed) => return Ok(Some(claimed)),
                Claiming::NothingDue => return Ok(None),
                Claiming::Overtaken => {}
            }
        }
    }

    pub(super) async fn reap_expired(&self) -> Result<u64, StoreError> {
        self.reap(self.expired().await?).await
    }

    /// Ends the attempts whose leases have expired, unless they were renewed meanwhile, and counts them.
    pub(super) async fn reap(&self, expired: Vec<(LeaseRow, WorkerDeath)>) -> Result<u64, StoreError> {
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
