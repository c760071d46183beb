//! The jobs of a list as a stream of server-sent events: each job as it is, whenever it has changed.
//!
//! Invariants: the stream begins with the jobs that have not ended; changes that are close together are one event; a job that leaves the
//! list is sent once more, or named as gone if it was deleted; one job is in memory at a time. The stream has no history, so whoever
//! reconnects reads the list again.

use std::{
    collections::{BTreeMap, VecDeque},
    convert::Infallible,
};

use axum::response::{Response, sse};
use futures_util::{Stream, stream};
use serde_json::json;
use tokio::time::sleep;

use super::{body, event_stream::respond};
use crate::{
    domain::{Caller, Credential, JobId},
    http::{meters::GaugeGuard, shared::Slot, state::AppState},
    store::{JobFilter, JobVersion, StoreError},
};

/// Newest jobs of a list that are followed, and so many that have not ended.
const FOLLOWED: u32 = 100;

/// Times of [`crate::http::config::RequestLimits::watch_interval`] between two looks at a list. Each stream looks by itself, and people
/// see no difference.
const RARER: u32 = 4;

/// A response with the jobs of the list.
pub(super) fn answer(
    state: AppState,
    caller: &Caller,
    filter: JobFilter,
    slot: Slot<Credential>,
) -> Response {
    let follower = Follower {
        filter,
        seen: None,
        waiting: VecDeque::new(),
        _slot: slot,
        _counted: state.meters.stream_opened(),
        state: state.clone(),
    };
    respond(state, caller.credential(), events(follower))
}

fn events(follower: Follower) -> impl Stream<Item = Result<sse::Event, Infallible>> {
    stream::unfold(follower, |mut follower| async move {
        let event = follower.next().await?;
        Some((Ok(event), follower))
    })
}

/// What is known of a list.
struct Follower {
    state: AppState,
    filter: JobFilter,
    /// The jobs as they were at the latest look; `None` before the first.
    seen: Option<BTreeMap<JobId, JobVersion>>,
    /// Jobs to be sent.
    waiting: VecDeque<Waiting>,
    _slot: Slot<Credential>,
    _counted: GaugeGuard,
}

/// A job to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Waiting {
    Changed(JobId),
    /// It had ended and is no longer among those that are followed, which is worth an event only if it was deleted.
    Absent(JobId),
}

impl Follower {
    /// The next event, once there is one.
    async fn next(&mut self) -> Option<sse::Event> {
        let draining = self.state.draining.clone();
        loop {
            let found = tokio::select! {
                // The client reconnects, to this server or another.
                () = draining.cancelled() => return None,
                found = self.step() => found,
            };
            match found {
                Ok(None) => {}
                Ok(event) => return event,
                Err(error) => {
                    let error_field = &error as &dyn std::error::Error;
                    tracing::warn!(error = error_field, "a stream of jobs ends early: {error}");
                    return None;
                }
            }
        }
    }

    /// Sends a job that waits, or looks for some.
    async fn step(&mut self) -> Result<Option<sse::Event>, StoreError> {
        let Some(job) = self.waiting.pop_front() else {
            self.look().await?;
            return Ok(None);
        };
        let (Waiting::Changed(id) | Waiting::Absent(id)) = job;
        let record = self.state.store().job(id).await?;
        Ok(match (record, job) {
            (Some(record), Waiting::Changed(_)) => Some(frame("job", &body::job(&record))),
            (Some(_), Waiting::Absent(_)) => None,
            (None, _) => Some(frame("gone", &json!({ "id": id }))),
        })
    }

    async fn look(&mut self) -> Result<(), StoreError> {
        if self.seen.is_some() {
            sleep(self.state.limits.watch_interval * RARER).await;
        }
        let now = self.state.store().job_versions(&self.filter, FOLLOWED).await?;
        self.waiting.extend(changes(self.seen.as_ref(), &now));
        self.seen = Some(now);
        Ok(())
    }
}

/// The jobs to be sent between two looks, in the order of their creation: identities are.
fn changes(before: Option<&BTreeMap<JobId, JobVersion>>, now: &BTreeMap<JobId, JobVersion>) -> Vec<Waiting> {
    let Some(before) = before else {
        let active = now.iter().filter(|(_, version)| !version.state.is_terminal());
        return active.map(|(id, _)| Waiting::Changed(*id)).collect();
    };
    let left = before.iter().filter(|(id, _)| !now.contains_key(id)).map(|(id, version)| {
        if version.state.is_terminal() { Waiting::Absent(*id) } else { Waiting::Changed(*id) }
    });
    let changed = now.iter().filter(|(id, version)| before.get(id) != Some(version));
    left.chain(changed.map(|(id, _)| Waiting::Changed(*id))).collect()
}

/// An event without a number: the stream has no history.
fn frame(name: &str, data: &serde_json::Value) -> sse::Event {
    sse::Event::default().event(name).data(data.to_string())
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::domain::JobState;

    fn jobs(all: &[(u128, u64, JobState)]) -> BTreeMap<JobId, JobVersion> {
        let job = |&(id, version, state)| (JobId(Uuid::from_u128(id)), JobVersion { version, state });
        all.iter().map(job).collect()
    }

    #[test]
    fn a_list_begins_with_what_has_not_ended_and_then_tells_of_changes() {
        use JobState::{Queued, Running, Succeeded};
        use Waiting::{Absent, Changed};
        let id = |id| JobId(Uuid::from_u128(id));
        let first = jobs(&[(1, 9, Succeeded), (2, 3, Running), (3, 1, Queued)]);
        assert_eq!(changes(None, &first), [Changed(id(2)), Changed(id(3))]);
        assert_eq!(changes(Some(&first), &first), []);
        let second = jobs(&[(3, 2, Running), (4, 1, Queued)]);
        assert_eq!(
            changes(Some(&first), &second),
            [Absent(id(1)), Changed(id(2)), Changed(id(3)), Changed(id(4))]
        );
    }
}
