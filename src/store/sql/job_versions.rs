//! Versions of the jobs of a list, by which a stream finds those that have changed.

use std::collections::BTreeMap;

use super::{Store, lists, rows};
use crate::{
    domain::{JobId, JobState},
    store::{JobFilter, JobVersion, StoreFuture},
};

impl Store {
    /// Versions of jobs that pass the filter: of the newest `limit`, and of the newest `limit` that have not ended.
    pub fn job_versions<'a>(
        &'a self,
        filter: &'a JobFilter,
        limit: u32,
    ) -> StoreFuture<'a, BTreeMap<JobId, JobVersion>> {
        self.call("job_versions").run(self.read(async move |tx| {
            let mut versions: BTreeMap<JobId, JobVersion> = lists::job_versions(filter, limit)
                .all(&mut *tx, rows::job_version)
                .await?
                .into_iter()
                .collect();
            let asked = |state| filter.states.is_empty() || filter.states.contains(&state);
            let active = lists::active_job_versions(filter, limit);
            for (state, active) in [JobState::Queued, JobState::Running].into_iter().zip(active) {
                if asked(state) {
                    versions.extend(active.all(&mut *tx, rows::job_version).await?);
                }
            }
            Ok(versions)
        }))
    }
}
