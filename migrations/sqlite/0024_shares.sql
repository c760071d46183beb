-- Links that open a job, or one thing of it, for those without a key, until they expire or are deleted.
CREATE TABLE shares (
    id         TEXT NOT NULL PRIMARY KEY,
    job_id     TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    -- Path and query below the job; NULL for the page of the job and all that it shows.
    target     TEXT,
    created_by TEXT,
    created_at INTEGER NOT NULL,
    expires_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX shares_by_job ON shares (job_id, created_at, id);
CREATE INDEX shares_by_expiry ON shares (expires_at);

-- What the service signs with, known to every process that has the database.
CREATE TABLE secrets (
    name  TEXT NOT NULL PRIMARY KEY,
    value TEXT NOT NULL
) STRICT, WITHOUT ROWID;
