//! The totals that the schema's triggers maintain, and the same by counting.

use super::database::Database;

/// The same as the totals, by counting.
const RECOUNTS: [(&str, &str); 5] = [
    (
        "SELECT project, digest, uses FROM project_blobs ORDER BY 1, 2",
        "SELECT project, digest, count(*) FROM (
             SELECT project, dataset AS digest FROM scenes
             UNION ALL SELECT project, dataset FROM jobs
             UNION ALL SELECT jobs.project, artifacts.digest FROM artifacts JOIN jobs ON jobs.id = job_id
             UNION ALL SELECT jobs.project, exports.digest FROM exports JOIN jobs ON jobs.id = job_id
         ) AS used GROUP BY 1, 2 ORDER BY 1, 2",
    ),
    (
        "SELECT project, dataset_bytes + artifact_bytes + export_bytes, queued_jobs + running_jobs FROM project_totals
         WHERE dataset_bytes + artifact_bytes + export_bytes <> 0 OR queued_jobs + running_jobs <> 0 ORDER BY 1",
        "SELECT project, CAST(sum(bytes) AS BIGINT), (SELECT count(*) FROM jobs WHERE jobs.project = used.project
             AND state IN ('queued', 'running'))
         FROM (SELECT project, dataset AS digest FROM scenes
             UNION SELECT project, dataset FROM jobs
             UNION SELECT jobs.project, artifacts.digest FROM artifacts JOIN jobs ON jobs.id = job_id
             UNION SELECT jobs.project, exports.digest FROM exports JOIN jobs ON jobs.id = job_id) AS used
         JOIN blobs USING (digest) GROUP BY 1 ORDER BY 1",
    ),
    (
        "SELECT project, artifact_bytes, export_bytes FROM project_totals WHERE artifact_bytes + export_bytes <> 0 ORDER BY 1",
        "SELECT * FROM (SELECT id,
             (SELECT CAST(COALESCE(sum(bytes), 0) AS BIGINT) FROM blobs WHERE digest IN
                 (SELECT artifacts.digest FROM artifacts JOIN jobs ON jobs.id = job_id WHERE project = projects.id)) AS artifacts,
             (SELECT CAST(COALESCE(sum(bytes), 0) AS BIGINT) FROM blobs WHERE digest IN
                 (SELECT exports.digest FROM exports JOIN jobs ON jobs.id = job_id WHERE project = projects.id)) AS exports
         FROM projects) AS sums WHERE artifacts + exports <> 0 ORDER BY 1",
    ),
    (
        "SELECT project, succeeded_jobs || ' ' || failed_jobs || ' ' || cancelled_jobs, running_jobs FROM project_totals ORDER BY 1",
        "SELECT id, (SELECT count(*) FILTER (WHERE state = 'succeeded') || ' ' || count(*) FILTER (WHERE state = 'failed') || ' ' ||
                 count(*) FILTER (WHERE state = 'cancelled') FROM jobs WHERE project = projects.id),
             (SELECT count(*) FROM jobs WHERE project = projects.id AND state = 'running')
         FROM projects ORDER BY 1",
    ),
    (
        "SELECT project, '', reserved_bytes FROM project_totals WHERE reserved_bytes <> 0 ORDER BY 1",
        "SELECT project, '', CAST(sum(length) AS BIGINT) FROM uploads WHERE ended_at IS NULL GROUP BY 1 HAVING sum(length) <> 0 ORDER BY 1",
    ),
];

/// On SQLite the totals of everything are rows; PostgreSQL has those of jobs by project, and rows of changes to the others.
const OF_EVERYTHING: [(&str, &str); 2] = [
    (
        "SELECT name, label, value FROM totals WHERE value <> 0 ORDER BY 1, 2",
        "SELECT 'blob_bytes', '', sum(bytes) FROM blobs HAVING count(*) > 0
         UNION ALL SELECT 'blobs', '', count(*) FROM blobs HAVING count(*) > 0
         UNION ALL SELECT 'deliveries', state, count(*) FROM webhook_deliveries GROUP BY state
         UNION ALL SELECT 'jobs', state, count(*) FROM jobs GROUP BY state ORDER BY 1, 2",
    ),
    (
        "SELECT name, label, CAST(sum(value) AS BIGINT) FROM
             (SELECT name, label, value FROM totals UNION ALL SELECT name, label, value FROM total_changes) AS changes
         GROUP BY 1, 2 HAVING sum(value) <> 0 ORDER BY 1, 2",
        "SELECT 'blob_bytes', '', CAST(sum(bytes) AS BIGINT) FROM blobs HAVING count(*) > 0
         UNION ALL SELECT 'blobs', '', count(*) FROM blobs HAVING count(*) > 0
         UNION ALL SELECT 'deliveries', state, count(*) FROM webhook_deliveries GROUP BY state ORDER BY 1, 2",
    ),
];

/// Compares the totals of a database with a recount.
pub async fn totals_equal_a_recount(database: &Database, after: &str) {
    let of_everything = OF_EVERYTHING[usize::from(database.is_postgres())];
    for (totals, recount) in RECOUNTS.into_iter().chain([of_everything]) {
        let [totals, recount] = [database.rows(totals, 3).await, database.rows(recount, 3).await];
        assert_eq!(totals, recount, "after {after}");
    }
}
