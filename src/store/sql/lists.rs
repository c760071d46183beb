//! The queries that list jobs, datasets, endpoints, keys and usage. Each names only the columns that it filters by, so that an index is used:
//! with `? IS NULL OR project = ?` it would scan the rows of all projects.

use super::{
    db::{Query, Sql, query},
    rows::micros,
};
use crate::{
    domain::{EndpointId, KeyId, ModelKind, ProjectId},
    store::{DatasetPageKey, JobFilter, PageKey},
};
use jiff::Timestamp;

/// Rows of `jobs` with their dataset's `bytes`, newest first.
pub(super) fn jobs(filter: &JobFilter, before: Option<PageKey>, limit: u32) -> Query {
    let list =
        query("SELECT jobs.*, blobs.bytes FROM jobs JOIN blobs ON blobs.digest = jobs.dataset WHERE true");
    matching_jobs(list, filter, before, limit)
}

/// Identity, version and state of jobs, newest first.
pub(super) fn job_versions(filter: &JobFilter, limit: u32) -> Query {
    let list = query("SELECT jobs.id, jobs.version, jobs.state FROM jobs WHERE true");
    matching_jobs(list, filter, None, limit)
}

/// The same of the queued and of the running jobs that the filter lets through, whatever states it names. Each state is part of the
/// statement, since the indexes of queued and of running jobs serve only statements that name it. Without a project SQLite has to be told,
/// or it would go through the whole history by age.
pub(super) fn active_job_versions(filter: &JobFilter, limit: u32) -> [Query; 2] {
    const QUEUED: &str = "SELECT jobs.id, jobs.version, jobs.state FROM jobs WHERE state = 'queued'";
    const RUNNING: &str = "SELECT jobs.id, jobs.version, jobs.state FROM jobs WHERE state = 'running'";
    let statements: [Sql; 2] = match filter.project {
        Some(_) => [QUEUED.into(), RUNNING.into()],
        None => [
            Sql {
                sqlite: "SELECT jobs.id, jobs.version, jobs.state FROM jobs INDEXED BY jobs_queued_by_age
                     WHERE state = 'queued'",
                postgres: QUEUED,
            },
            Sql {
                sqlite: "SELECT jobs.id, jobs.version, jobs.state FROM jobs INDEXED BY jobs_by_lease
                     WHERE state = 'running'",
                postgres: RUNNING,
            },
        ],
    };
    let of_any_state = JobFilter { states: Vec::new(), ..filter.clone() };
    statements.map(|statement| matching_jobs(query(statement), &of_any_state, None, limit))
}

/// Continues a statement that ends within the condition on `jobs`.
fn matching_jobs(mut list: Query, filter: &JobFilter, before: Option<PageKey>, limit: u32) -> Query {
    if let Some(before) = before {
        list.push(" AND (jobs.created_at, jobs.id) < (").push_bind(micros(before.created_at));
        list.push(", ").push_bind(before.id.to_string()).push(")");
    }
    list.push_if(" AND project = ", filter.project.map(|project| project.to_string()));
    list.push_if(" AND scene = ", filter.dataset_id.map(|dataset| dataset.to_string()));
    if !filter.states.is_empty() {
        list.push(" AND state IN (");
        for (number, state) in filter.states.iter().enumerate() {
            list.push(if number == 0 { "" } else { ", " }).push_bind(state.name());
        }
        list.push(")");
    }
    list.push_if(" AND name = ", filter.name.clone());
    list.push_if(" AND jobs.created_at >= ", filter.created_from.map(micros));
    list.push_if(" AND jobs.created_at < ", filter.created_before.map(micros));
    if let Some(model) = filter.model {
        list.push(Sql {
            sqlite: " AND json_extract(options, '$.model') = ",
            postgres: " AND CAST(options AS jsonb) ->> 'model' = ",
        });
        list.push_bind(ModelKind::name(model));
    }
    for (key, value) in filter.metadata.iter() {
        // A key has no characters that a JSON path would read as more than a name.
        list.push(Sql {
            sqlite: " AND json_extract(metadata, '$.\"' || ",
            postgres: " AND CAST(metadata AS jsonb) ->> ",
        });
        list.push_bind(key).push(Sql { sqlite: " || '\"') = ", postgres: " = " }).push_bind(value);
    }
    list.push(" ORDER BY jobs.created_at DESC, jobs.id DESC LIMIT ").push_bind(limit);
    list
}

/// Rows of `scenes` with their dataset's `bytes`, newest first.
pub(super) fn datasets(project: Option<ProjectId>, before: Option<DatasetPageKey>, limit: u32) -> Query {
    let mut list = query(
        "SELECT scenes.*, blobs.bytes FROM scenes JOIN blobs ON blobs.digest = scenes.dataset WHERE true",
    );
    if let Some(before) = before {
        list.push(" AND (scenes.created_at, scenes.id) < (").push_bind(micros(before.created_at));
        list.push(", ").push_bind(before.id.to_string()).push(")");
    }
    list.push_if(" AND project = ", project.map(|project| project.to_string()));
    list.push(" ORDER BY scenes.created_at DESC, scenes.id DESC LIMIT ").push_bind(limit);
    list
}

/// Rows of `webhook_endpoints`, newest first: identities are in the order of creation.
pub(super) fn endpoints(project: Option<ProjectId>, before: Option<EndpointId>, limit: u32) -> Query {
    let mut list = query("SELECT * FROM webhook_endpoints WHERE true");
    list.push_if(" AND project = ", project.map(|project| project.to_string()));
    list.push_if(" AND id < ", before.map(|before| before.to_string()));
    list.push(" ORDER BY id DESC LIMIT ").push_bind(limit);
    list
}

/// Rows of `keys`, newest first: identities are in the order of creation.
pub(super) fn keys(
    project: Option<ProjectId>,
    with_revoked: bool,
    before: Option<KeyId>,
    limit: u32,
) -> Query {
    let mut list = query("SELECT * FROM keys WHERE true");
    list.push_if(" AND project = ", project.map(|project| project.to_string()));
    if !with_revoked {
        list.push(" AND revoked_at IS NULL");
    }
    list.push_if(" AND id < ", before.map(|before| before.to_string()));
    list.push(" ORDER BY id DESC LIMIT ").push_bind(limit);
    list
}

/// Totals of projects with their rows of `projects` and the seconds of their running attempts until `now`, newest first.
pub(super) fn usage(
    project: Option<ProjectId>,
    before: Option<ProjectId>,
    limit: u32,
    now: Timestamp,
) -> Query {
    let mut list = query(Sql {
        sqlite: "SELECT *, COALESCE((SELECT SUM(MAX(0, ",
        postgres: "SELECT *, CAST(COALESCE((SELECT SUM(GREATEST(0, ",
    });
    list.push_bind(micros(now)).push(Sql {
        sqlite: " - jobs.started_at)) FROM jobs INDEXED BY jobs_running
             WHERE jobs.project = projects.id AND state = 'running'), 0) AS running_micros",
        postgres: " - jobs.started_at)) FROM jobs
             WHERE jobs.project = projects.id AND state = 'running'), 0) AS bigint) AS running_micros",
    });
    list.push(" FROM projects JOIN project_totals ON project_totals.project = projects.id WHERE true");
    list.push_if(" AND projects.id = ", project.map(|project| project.to_string()));
    list.push_if(" AND projects.id < ", before.map(|before| before.to_string()));
    list.push(" ORDER BY projects.id DESC LIMIT ").push_bind(limit);
    list
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::{
        domain::{DatasetId, JobId, JobState},
        store::{
            Store,
            sql::{
                ANY_RUNNING, FIRST_DEADLINE, accounts, datasets, open::temporary_store, queue, retention,
                stats,
            },
        },
    };

    /// SQLite's query plan of a statement.
    async fn plan(store: &Store, statement: &str) -> Vec<String> {
        let mut explained = query("EXPLAIN QUERY PLAN ");
        explained.push_text(statement);
        let rows = explained.fetch_all(&store.readers).await.expect("a plan");
        rows.iter().map(|row| row.try_get("detail").expect("a step")).collect()
    }

    #[tokio::test]
    async fn lists_read_only_the_rows_that_they_return() {
        let (_folder, store) = temporary_store().await;
        let project = Some(ProjectId(Uuid::from_u128(1)));
        let scene = Some(DatasetId(Uuid::from_u128(1)));
        let at = jiff::Timestamp::UNIX_EPOCH;
        let job = Some(PageKey { created_at: at, id: JobId(Uuid::from_u128(1)) });
        let page = Some(DatasetPageKey { created_at: at, id: DatasetId(Uuid::from_u128(1)) });
        let all = JobFilter::default();
        let of_project = JobFilter { project, ..JobFilter::default() };
        let of_scene = JobFilter { dataset_id: scene, ..JobFilter::default() };
        let queued = JobFilter { project, states: vec![JobState::Queued], ..JobFilter::default() };
        let named = JobFilter { project, name: Some("a name".into()), ..JobFilter::default() };
        let of_time =
            JobFilter { project, created_from: Some(at), created_before: Some(at), ..JobFilter::default() };
        let cases = [
            (jobs(&all, None, 20), "jobs_by_age"),
            (jobs(&all, job, 20), "jobs_by_age"),
            (jobs(&of_project, None, 20), "jobs_by_project "),
            (jobs(&of_project, job, 20), "jobs_by_project "),
            (jobs(&queued, job, 20), "jobs_by_project_state"),
            (jobs(&of_scene, job, 20), "jobs_by_scene"),
            (jobs(&named, job, 20), "jobs_by_project_name"),
            (jobs(&JobFilter { project: None, ..named.clone() }, job, 20), "jobs_by_name"),
            (jobs(&of_time, job, 20), "jobs_by_project "),
            (job_versions(&all, 20), "jobs_by_age"),
            (job_versions(&of_project, 20), "jobs_by_project "),
            (job_versions(&queued, 20), "jobs_by_project_state"),
            (keys(project, false, None, 20), "keys_by_project"),
            (keys(project, true, Some(KeyId(Uuid::from_u128(1))), 20), "keys_by_project"),
            (usage(project, None, 20, at), "project_totals USING PRIMARY KEY"),
            (datasets(None, page, 20), "scenes_by_age"),
            (datasets(project, None, 20), "scenes_by_project"),
            (datasets(project, page, 20), "scenes_by_project"),
            (endpoints(project, None, 20), "webhook_endpoints_by_project"),
            (query(FIRST_DEADLINE), "jobs_by_deadline (deadline_at>?)"),
            (retention::ended_jobs(at, None), "jobs_by_age"),
            (retention::ended_jobs(at, job), "jobs_by_age"),
        ];
        for (query, index) in cases {
            let (statement, _) = query.texts();
            let plan = plan(&store, &statement).await;
            assert!(plan[0].contains(index), "{}: {plan:?}", statement);
            // A project has few endpoints.
            let sorts = plan.iter().any(|step| step.contains("TEMP B-TREE"));
            assert!(!sorts || index.starts_with("webhook"), "{}: {plan:?}", statement);
        }
    }

    #[tokio::test]
    async fn active_jobs_are_found_without_the_history() {
        let (_folder, store) = temporary_store().await;
        let project = Some(ProjectId(Uuid::from_u128(1)));
        for filter in [JobFilter::default(), JobFilter { project, ..JobFilter::default() }] {
            for (query, state) in active_job_versions(&filter, 20).into_iter().zip(["queued", "running"]) {
                let (statement, _) = query.texts();
                let plan = plan(&store, &statement).await;
                let narrow = ["jobs_queued_by_age", "jobs_by_lease", "jobs_running", "jobs_by_project_state"];
                assert!(narrow.iter().any(|index| plan[0].contains(index)), "{state}: {plan:?}");
            }
        }
    }

    #[tokio::test]
    async fn nothing_under_the_write_lock_and_no_metric_scans_a_table() {
        let (_folder, store) = temporary_store().await;
        // The few rows of totals and counters, an index of the running jobs, and one of the projects that have queued jobs.
        let whole = [
            "SCAN CONSTANT ROW",
            "SCAN totals",
            "SCAN counters",
            "SCAN jobs USING INDEX jobs_by_lease",
            "SCAN jobs USING COVERING INDEX jobs_by_lease",
            "SCAN totals USING INDEX project_totals_queued",
        ];
        let all = accounts::STATEMENTS
            .into_iter()
            .chain([ANY_RUNNING])
            .map(Sql::from)
            .chain(stats::STATEMENTS)
            .chain(queue::statements());
        for statement in all.map(|statement| statement.sqlite) {
            for step in plan(&store, statement).await {
                // Of a query within it, whose own steps are checked too.
                let is_inner = step.starts_with("SCAN (subquery");
                assert!(
                    !step.starts_with("SCAN") || is_inner || whole.contains(&&*step),
                    "{statement}: {step}"
                );
            }
        }
        for statement in [
            "DELETE FROM jobs WHERE id = ? AND finished_at IS NOT NULL",
            retention::EXPIRED_REQUESTS,
            retention::EXPIRED_MESSAGES,
            "UPDATE jobs SET retry_of = NULL, version = version + 1 WHERE retry_of = ?",
            datasets::CLEAR_SCENE,
            datasets::REMOVE_UNUSED,
            "DELETE FROM scenes WHERE id = ?",
        ] {
            for step in plan(&store, statement).await {
                assert!(!step.starts_with("SCAN"), "{statement}: {step}");
            }
        }
        for statement in accounts::OF_ARCHIVES {
            let [first, then] = &plan(&store, statement).await[..] else { panic!("{statement}") };
            assert!(first.starts_with("SEARCH project_blobs USING PRIMARY KEY"), "{statement}: {first}");
            assert!(then.starts_with("SEARCH blobs USING INDEX"), "{statement}: {then}");
        }
        let (unreferenced, _) = accounts::unreferenced_among(String::new()).texts();
        for step in plan(&store, &unreferenced).await {
            let is_given = step.starts_with("SCAN json_each");
            assert!(!step.starts_with("SCAN") || is_given, "{unreferenced}: {step}");
        }
    }
}
