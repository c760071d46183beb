-- What is stored belongs to a project, and keys to projects: a leaked key is revoked, and another one of its project has everything.
-- Each key so far gets a project of its own, with the key's identity and limits. The nil project has what was made without a key.
-- `owner` of a job is the key that made it; in scenes, uploads and webhook_endpoints it is read no more.

CREATE TABLE projects (
    id               TEXT PRIMARY KEY,
    name             TEXT NOT NULL,
    max_bytes        INTEGER CHECK (max_bytes >= 0),
    max_active_jobs  INTEGER CHECK (max_active_jobs >= 0),
    max_running_jobs INTEGER CHECK (max_running_jobs >= 0),
    max_priority     INTEGER CHECK (max_priority BETWEEN -100 AND 100),
    version          INTEGER NOT NULL DEFAULT 1,
    created_at       INTEGER NOT NULL
) STRICT;

INSERT INTO projects (id, name, created_at) VALUES ('00000000-0000-0000-0000-000000000000', 'default', 0);
INSERT INTO projects (id, name, max_bytes, max_active_jobs, max_priority, created_at)
SELECT id, name, max_bytes, max_active_jobs, max_priority, created_at FROM keys;

ALTER TABLE keys ADD COLUMN project TEXT REFERENCES projects (id);
ALTER TABLE keys ADD COLUMN expires_at INTEGER;
-- Of the limits in keys only requests_per_minute is read from now on.
UPDATE keys SET project = id;
CREATE INDEX keys_by_project ON keys (project, id);

-- Totals by project, as 0011 has them by owner. What is stored is told apart by kind; a blob of two kinds counts as the first of them.

DROP TRIGGER owner_blobs_added;
DROP TRIGGER owner_blobs_unused;
DROP TRIGGER owner_blobs_removed;
DROP TRIGGER scenes_added;
DROP TRIGGER scenes_removed;
DROP TRIGGER artifacts_added;
DROP TRIGGER artifacts_removed;
DROP TRIGGER exports_added;
DROP TRIGGER exports_removed;
DROP TRIGGER jobs_added;
DROP TRIGGER jobs_changed;
DROP TRIGGER jobs_removed;
DROP TRIGGER attempts_added;
DROP TRIGGER attempts_ended;
DROP TRIGGER uploads_added;
DROP TRIGGER uploads_ended;
DROP TRIGGER uploads_removed;

ALTER TABLE jobs ADD COLUMN project TEXT REFERENCES projects (id);
-- What its user calls it, and what its user notes about it: a JSON object of strings.
ALTER TABLE jobs ADD COLUMN name TEXT;
ALTER TABLE jobs ADD COLUMN metadata TEXT NOT NULL DEFAULT '{}';
ALTER TABLE scenes ADD COLUMN project TEXT REFERENCES projects (id);
ALTER TABLE uploads ADD COLUMN project TEXT REFERENCES projects (id);
ALTER TABLE webhook_endpoints ADD COLUMN project TEXT REFERENCES projects (id);

DROP INDEX jobs_by_owner;
DROP INDEX jobs_by_owner_state;
DROP INDEX scenes_of_an_owner;
DROP INDEX scenes_by_owner;
DROP INDEX uploads_by_owner;
DROP INDEX webhook_endpoints_by_owner;
DROP INDEX jobs_to_claim;

UPDATE jobs SET project = IFNULL(owner, '00000000-0000-0000-0000-000000000000');
UPDATE scenes SET project = IFNULL(owner, '00000000-0000-0000-0000-000000000000');
UPDATE uploads SET project = IFNULL(owner, '00000000-0000-0000-0000-000000000000');
UPDATE webhook_endpoints SET project = IFNULL(owner, '00000000-0000-0000-0000-000000000000');

CREATE INDEX jobs_by_project ON jobs (project, created_at, id);
CREATE INDEX jobs_by_project_state ON jobs (project, state, created_at, id);
CREATE INDEX jobs_by_project_name ON jobs (project, name, created_at, id) WHERE name IS NOT NULL;
CREATE INDEX jobs_by_name ON jobs (name, created_at, id) WHERE name IS NOT NULL;
CREATE INDEX jobs_to_claim ON jobs (project, priority DESC, created_at, id) WHERE state = 'queued';
CREATE INDEX jobs_running ON jobs (project) WHERE state = 'running';
CREATE UNIQUE INDEX scenes_of_a_project ON scenes (project, dataset);
CREATE INDEX scenes_by_project ON scenes (project, created_at, id);
CREATE INDEX uploads_by_project ON uploads (project);
CREATE INDEX webhook_endpoints_by_project ON webhook_endpoints (project);

ALTER TABLE idempotency RENAME COLUMN owner TO project;
UPDATE idempotency SET project = '00000000-0000-0000-0000-000000000000' WHERE project = '';

CREATE TABLE project_totals (
    project        TEXT PRIMARY KEY REFERENCES projects (id) ON DELETE CASCADE,
    queued_jobs    INTEGER NOT NULL DEFAULT 0,
    running_jobs   INTEGER NOT NULL DEFAULT 0,
    succeeded_jobs INTEGER NOT NULL DEFAULT 0,
    failed_jobs    INTEGER NOT NULL DEFAULT 0,
    cancelled_jobs INTEGER NOT NULL DEFAULT 0,
    -- Bytes of the blobs in project_blobs, by their kind.
    dataset_bytes  INTEGER NOT NULL DEFAULT 0,
    artifact_bytes INTEGER NOT NULL DEFAULT 0,
    export_bytes   INTEGER NOT NULL DEFAULT 0,
    -- Bytes promised to uploads that have not ended.
    reserved_bytes INTEGER NOT NULL DEFAULT 0,
    -- How long ended attempts had a worker, with its processor and adapter, in microseconds. Never falls.
    worker_micros  INTEGER NOT NULL DEFAULT 0,
    -- The number of the latest claim of one of its jobs, which decides whose turn is next; 0 once none is queued or running.
    last_claim     INTEGER NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;

CREATE INDEX project_totals_queued ON project_totals (project) WHERE queued_jobs > 0;

-- How often a project's scenes, jobs, artifacts and exports refer to a blob.
CREATE TABLE project_blobs (
    project TEXT NOT NULL,
    digest  TEXT NOT NULL,
    uses    INTEGER NOT NULL,
    kind    TEXT NOT NULL CHECK (kind IN ('dataset', 'artifact', 'export')),
    PRIMARY KEY (project, digest)
) STRICT, WITHOUT ROWID;

INSERT INTO project_blobs (project, digest, uses, kind)
SELECT IIF(owner = '', '00000000-0000-0000-0000-000000000000', owner), digest, uses,
    CASE
        WHEN EXISTS (SELECT 1 FROM scenes WHERE dataset = digest) OR EXISTS (SELECT 1 FROM jobs WHERE dataset = digest) THEN 'dataset'
        WHEN EXISTS (SELECT 1 FROM artifacts WHERE artifacts.digest = owner_blobs.digest) THEN 'artifact'
        ELSE 'export'
    END
FROM owner_blobs;

INSERT INTO project_totals (project) SELECT id FROM projects;
UPDATE project_totals SET
    dataset_bytes = sums.datasets, artifact_bytes = sums.artifacts, export_bytes = sums.exports
FROM (
    SELECT project, SUM(IIF(kind = 'dataset', bytes, 0)) AS datasets, SUM(IIF(kind = 'artifact', bytes, 0)) AS artifacts,
        SUM(IIF(kind = 'export', bytes, 0)) AS exports
    FROM project_blobs JOIN blobs USING (digest) GROUP BY project
) AS sums WHERE sums.project = project_totals.project;
UPDATE project_totals SET
    queued_jobs = sums.queued, running_jobs = sums.running, succeeded_jobs = sums.succeeded, failed_jobs = sums.failed,
    cancelled_jobs = sums.cancelled
FROM (
    SELECT project, SUM(state = 'queued') AS queued, SUM(state = 'running') AS running, SUM(state = 'succeeded') AS succeeded,
        SUM(state = 'failed') AS failed, SUM(state = 'cancelled') AS cancelled
    FROM jobs GROUP BY project
) AS sums WHERE sums.project = project_totals.project;
UPDATE project_totals SET reserved_bytes = sums.bytes
FROM (SELECT project, SUM(length) AS bytes FROM uploads WHERE ended_at IS NULL GROUP BY project) AS sums
WHERE sums.project = project_totals.project;
UPDATE project_totals SET worker_micros = sums.micros
FROM (
    SELECT project, SUM(MAX(0, ended_at - attempts.started_at)) AS micros
    FROM attempts JOIN jobs ON jobs.id = job_id WHERE ended_at IS NOT NULL GROUP BY project
) AS sums WHERE sums.project = project_totals.project;

DROP TABLE owner_blobs;
DROP TABLE owner_totals;

-- Every row has a project. SQLite cannot add such a constraint to a column that refers to another table.

CREATE TRIGGER keys_without_project BEFORE INSERT ON keys WHEN NEW.project IS NULL BEGIN
    SELECT RAISE(ABORT, 'keys.project is missing');
END;
CREATE TRIGGER jobs_without_project BEFORE INSERT ON jobs WHEN NEW.project IS NULL BEGIN
    SELECT RAISE(ABORT, 'jobs.project is missing');
END;
CREATE TRIGGER scenes_without_project BEFORE INSERT ON scenes WHEN NEW.project IS NULL BEGIN
    SELECT RAISE(ABORT, 'scenes.project is missing');
END;
CREATE TRIGGER uploads_without_project BEFORE INSERT ON uploads WHEN NEW.project IS NULL BEGIN
    SELECT RAISE(ABORT, 'uploads.project is missing');
END;
CREATE TRIGGER webhook_endpoints_without_project BEFORE INSERT ON webhook_endpoints WHEN NEW.project IS NULL BEGIN
    SELECT RAISE(ABORT, 'webhook_endpoints.project is missing');
END;

CREATE TRIGGER projects_added AFTER INSERT ON projects BEGIN
    INSERT INTO project_totals (project) VALUES (NEW.id);
END;

CREATE TRIGGER project_blobs_added AFTER INSERT ON project_blobs BEGIN
    UPDATE project_totals SET
        dataset_bytes = dataset_bytes + IIF(NEW.kind = 'dataset', (SELECT bytes FROM blobs WHERE digest = NEW.digest), 0),
        artifact_bytes = artifact_bytes + IIF(NEW.kind = 'artifact', (SELECT bytes FROM blobs WHERE digest = NEW.digest), 0),
        export_bytes = export_bytes + IIF(NEW.kind = 'export', (SELECT bytes FROM blobs WHERE digest = NEW.digest), 0)
    WHERE project = NEW.project;
END;
CREATE TRIGGER project_blobs_unused AFTER UPDATE OF uses ON project_blobs WHEN NEW.uses = 0 BEGIN
    DELETE FROM project_blobs WHERE project = NEW.project AND digest = NEW.digest;
END;
CREATE TRIGGER project_blobs_removed AFTER DELETE ON project_blobs BEGIN
    UPDATE project_totals SET
        dataset_bytes = dataset_bytes - IIF(OLD.kind = 'dataset', (SELECT bytes FROM blobs WHERE digest = OLD.digest), 0),
        artifact_bytes = artifact_bytes - IIF(OLD.kind = 'artifact', (SELECT bytes FROM blobs WHERE digest = OLD.digest), 0),
        export_bytes = export_bytes - IIF(OLD.kind = 'export', (SELECT bytes FROM blobs WHERE digest = OLD.digest), 0)
    WHERE project = OLD.project;
END;

CREATE TRIGGER scenes_added AFTER INSERT ON scenes BEGIN
    INSERT INTO project_blobs (project, digest, uses, kind) VALUES (NEW.project, NEW.dataset, 1, 'dataset')
    ON CONFLICT (project, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER scenes_removed AFTER DELETE ON scenes BEGIN
    UPDATE project_blobs SET uses = uses - 1 WHERE project = OLD.project AND digest = OLD.dataset;
END;

CREATE TRIGGER artifacts_added AFTER INSERT ON artifacts BEGIN
    INSERT INTO project_blobs (project, digest, uses, kind)
    SELECT project, NEW.digest, 1, 'artifact' FROM jobs WHERE id = NEW.job_id
    ON CONFLICT (project, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER artifacts_removed AFTER DELETE ON artifacts BEGIN
    UPDATE project_blobs SET uses = uses - 1
    WHERE digest = OLD.digest AND project = (SELECT project FROM jobs WHERE id = OLD.job_id);
END;

CREATE TRIGGER exports_added AFTER INSERT ON exports BEGIN
    INSERT INTO project_blobs (project, digest, uses, kind)
    SELECT project, NEW.digest, 1, 'export' FROM jobs WHERE id = NEW.job_id
    ON CONFLICT (project, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER exports_removed AFTER DELETE ON exports BEGIN
    UPDATE project_blobs SET uses = uses - 1
    WHERE digest = OLD.digest AND project = (SELECT project FROM jobs WHERE id = OLD.job_id);
END;

CREATE TRIGGER jobs_added AFTER INSERT ON jobs BEGIN
    INSERT INTO project_blobs (project, digest, uses, kind) VALUES (NEW.project, NEW.dataset, 1, 'dataset')
    ON CONFLICT (project, digest) DO UPDATE SET uses = uses + 1;
    UPDATE project_totals SET
        queued_jobs = queued_jobs + (NEW.state = 'queued'), running_jobs = running_jobs + (NEW.state = 'running'),
        succeeded_jobs = succeeded_jobs + (NEW.state = 'succeeded'), failed_jobs = failed_jobs + (NEW.state = 'failed'),
        cancelled_jobs = cancelled_jobs + (NEW.state = 'cancelled')
    WHERE project = NEW.project;
    UPDATE totals SET value = value + 1 WHERE name = 'jobs' AND label = NEW.state;
END;
CREATE TRIGGER jobs_changed AFTER UPDATE OF state ON jobs WHEN OLD.state <> NEW.state BEGIN
    UPDATE project_totals SET
        queued_jobs = queued_jobs + (NEW.state = 'queued') - (OLD.state = 'queued'),
        running_jobs = running_jobs + (NEW.state = 'running') - (OLD.state = 'running'),
        succeeded_jobs = succeeded_jobs + (NEW.state = 'succeeded') - (OLD.state = 'succeeded'),
        failed_jobs = failed_jobs + (NEW.state = 'failed') - (OLD.state = 'failed'),
        cancelled_jobs = cancelled_jobs + (NEW.state = 'cancelled') - (OLD.state = 'cancelled')
    WHERE project = NEW.project;
    UPDATE project_totals SET last_claim = 0 WHERE project = NEW.project AND queued_jobs + running_jobs = 0;
    UPDATE totals SET value = value + IIF(label = NEW.state, 1, -1)
    WHERE name = 'jobs' AND label IN (OLD.state, NEW.state);
END;
CREATE TRIGGER jobs_removed AFTER DELETE ON jobs BEGIN
    UPDATE project_blobs SET uses = uses - 1 WHERE project = OLD.project AND digest = OLD.dataset;
    UPDATE project_totals SET
        queued_jobs = queued_jobs - (OLD.state = 'queued'), running_jobs = running_jobs - (OLD.state = 'running'),
        succeeded_jobs = succeeded_jobs - (OLD.state = 'succeeded'), failed_jobs = failed_jobs - (OLD.state = 'failed'),
        cancelled_jobs = cancelled_jobs - (OLD.state = 'cancelled')
    WHERE project = OLD.project;
    UPDATE totals SET value = value - 1 WHERE name = 'jobs' AND label = OLD.state;
END;

CREATE TRIGGER attempts_added AFTER INSERT ON attempts BEGIN
    UPDATE counters SET value = value + 1 WHERE name = 'claims';
    UPDATE project_totals SET last_claim = (SELECT CAST(value AS INTEGER) FROM counters WHERE name = 'claims')
    WHERE project = (SELECT project FROM jobs WHERE id = NEW.job_id);
END;
CREATE TRIGGER attempts_ended AFTER UPDATE OF outcome ON attempts WHEN OLD.outcome IS NULL AND NEW.outcome IS NOT NULL BEGIN
    INSERT INTO counters (name, label, cause, value)
    VALUES ('attempts_ended', NEW.outcome, IFNULL(json_extract(NEW.cause, '$.type'), ''), 1)
    ON CONFLICT (name, label, cause) DO UPDATE SET value = value + 1;
    UPDATE project_totals SET worker_micros = worker_micros + MAX(0, NEW.ended_at - NEW.started_at)
    WHERE project = (SELECT project FROM jobs WHERE id = NEW.job_id);
END;

CREATE TRIGGER uploads_added AFTER INSERT ON uploads WHEN NEW.ended_at IS NULL BEGIN
    UPDATE project_totals SET reserved_bytes = reserved_bytes + NEW.length WHERE project = NEW.project;
END;
CREATE TRIGGER uploads_ended AFTER UPDATE OF ended_at ON uploads WHEN (OLD.ended_at IS NULL) <> (NEW.ended_at IS NULL) BEGIN
    UPDATE project_totals SET reserved_bytes = reserved_bytes + IIF(NEW.ended_at IS NULL, NEW.length, -NEW.length)
    WHERE project = NEW.project;
END;
CREATE TRIGGER uploads_removed AFTER DELETE ON uploads WHEN OLD.ended_at IS NULL BEGIN
    UPDATE project_totals SET reserved_bytes = reserved_bytes - OLD.length WHERE project = OLD.project;
END;
