//! The queries that list jobs, datasets and endpoints. Each names only the columns that it filters by, so that SQLite uses an index:
//! with `? IS NULL OR owner = ?` it would scan the rows of all owners.

use sqlx::{QueryBuilder, Sqlite};

use super::rows::micros;
use crate::{
    domain::{EndpointId, KeyId, ModelKind},
    store::{DatasetPageKey, JobFilter, PageKey},
};

/// Rows of `jobs` with their dataset's `bytes`, newest first.
pub(super) fn jobs(filter: &JobFilter, before: Option<PageKey>, limit: u32) -> QueryBuilder<Sqlite> {
    let mut query = QueryBuilder::new(
        "SELECT jobs.*, blobs.bytes FROM jobs JOIN blobs ON blobs.digest = jobs.dataset WHERE true",
    );
    if let Some(before) = before {
        query.push(" AND (jobs.created_at, jobs.id) < (").push_bind(micros(before.created_at));
        query.push(", ").push_bind(before.id.to_string()).push(")");
    }
    if let Some(owner) = filter.owner {
        query.push(" AND owner = ").push_bind(owner.to_string());
    }
    if let Some(dataset) = filter.dataset_id {
        query.push(" AND scene = ").push_bind(dataset.to_string());
    }
    if !filter.states.is_empty() {
        query.push(" AND state IN (");
        let mut states = query.separated(", ");
        for state in &filter.states {
            states.push_bind(state.name());
        }
        query.push(")");
    }
    if let Some(model) = filter.model {
        query.push(" AND json_extract(options, '$.model') = ").push_bind(ModelKind::name(model));
    }
    query.push(" ORDER BY jobs.created_at DESC, jobs.id DESC LIMIT ").push_bind(limit);
    query
}

/// Rows of `scenes` with their dataset's `bytes`, newest first.
pub(super) fn datasets(
    owner: Option<KeyId>,
    before: Option<DatasetPageKey>,
    limit: u32,
) -> QueryBuilder<Sqlite> {
    let mut query = QueryBuilder::new(
        "SELECT scenes.*, blobs.bytes FROM scenes JOIN blobs ON blobs.digest = scenes.dataset WHERE true",
    );
    if let Some(before) = before {
        query.push(" AND (scenes.created_at, scenes.id) < (").push_bind(micros(before.created_at));
        query.push(", ").push_bind(before.id.to_string()).push(")");
    }
    if let Some(owner) = owner {
        query.push(" AND owner = ").push_bind(owner.to_string());
    }
    query.push(" ORDER BY scenes.created_at DESC, scenes.id DESC LIMIT ").push_bind(limit);
    query
}

/// Rows of `webhook_endpoints`, newest first: identities are in the order of creation.
pub(super) fn endpoints(
    owner: Option<KeyId>,
    before: Option<EndpointId>,
    limit: u32,
) -> QueryBuilder<Sqlite> {
    let mut query = QueryBuilder::new("SELECT * FROM webhook_endpoints WHERE true");
    if let Some(owner) = owner {
        query.push(" AND owner = ").push_bind(owner.to_string());
    }
    if let Some(before) = before {
        query.push(" AND id < ").push_bind(before.to_string());
    }
    query.push(" ORDER BY id DESC LIMIT ").push_bind(limit);
    query
}

#[cfg(test)]
mod tests {
    use sqlx::Row as _;
    use uuid::Uuid;

    use super::*;
    use crate::{
        domain::{DatasetId, JobId, JobState},
        store::{
            SqliteStore,
            sqlite::{accounts, open::temporary_store, stats},
        },
    };

    /// SQLite's query plan of a statement.
    async fn plan(store: &SqliteStore, statement: &str) -> Vec<String> {
        let explained = sqlx::AssertSqlSafe(format!("EXPLAIN QUERY PLAN {statement}"));
        let rows = sqlx::query(explained).fetch_all(&store.readers).await.expect("a plan");
        rows.iter().map(|row| row.get("detail")).collect()
    }

    #[tokio::test]
    async fn lists_read_only_the_rows_that_they_return() {
        let (_folder, store) = temporary_store().await;
        let owner = Some(KeyId(Uuid::from_u128(1)));
        let scene = Some(DatasetId(Uuid::from_u128(1)));
        let at = jiff::Timestamp::UNIX_EPOCH;
        let job = Some(PageKey { created_at: at, id: JobId(Uuid::from_u128(1)) });
        let page = Some(DatasetPageKey { created_at: at, id: DatasetId(Uuid::from_u128(1)) });
        let all = JobFilter::default();
        let of_owner = JobFilter { owner, ..JobFilter::default() };
        let of_scene = JobFilter { dataset_id: scene, ..JobFilter::default() };
        let queued = JobFilter { owner, states: vec![JobState::Queued], ..JobFilter::default() };
        let cases = [
            (jobs(&all, None, 20), "jobs_by_age"),
            (jobs(&all, job, 20), "jobs_by_age"),
            (jobs(&of_owner, None, 20), "jobs_by_owner "),
            (jobs(&of_owner, job, 20), "jobs_by_owner "),
            (jobs(&queued, job, 20), "jobs_by_owner_state"),
            (jobs(&of_scene, job, 20), "jobs_by_scene"),
            (datasets(None, page, 20), "scenes_by_age"),
            (datasets(owner, None, 20), "scenes_by_owner"),
            (datasets(owner, page, 20), "scenes_by_owner"),
            (endpoints(owner, None, 20), "webhook_endpoints_by_owner"),
        ];
        for (query, index) in cases {
            let statement = query.sql();
            let plan = plan(&store, statement.as_str()).await;
            assert!(plan[0].contains(index), "{}: {plan:?}", statement.as_str());
            // An owner has few endpoints.
            let sorts = plan.iter().any(|step| step.contains("TEMP B-TREE"));
            assert!(!sorts || index.starts_with("webhook"), "{}: {plan:?}", statement.as_str());
        }
    }

    #[tokio::test]
    async fn nothing_under_the_write_lock_and_no_metric_scans_a_table() {
        let (_folder, store) = temporary_store().await;
        // The few rows of totals and counters, and an index of the running jobs.
        let whole =
            ["SCAN CONSTANT ROW", "SCAN totals", "SCAN counters", "SCAN jobs USING INDEX jobs_by_lease"];
        for statement in accounts::STATEMENTS.into_iter().chain(stats::STATEMENTS) {
            for step in plan(&store, statement).await {
                assert!(!step.starts_with("SCAN") || whole.contains(&&*step), "{statement}: {step}");
            }
        }
        for statement in [
            "DELETE FROM jobs WHERE id = ?",
            "UPDATE jobs SET retry_of = NULL, version = version + 1 WHERE retry_of = ?",
            "DELETE FROM scenes WHERE id = ?",
        ] {
            for step in plan(&store, statement).await {
                assert!(!step.starts_with("SCAN"), "{statement}: {step}");
            }
        }
    }
}
