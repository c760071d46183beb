-- Totals that are kept instead of counted: admission and metrics read a few rows however many jobs there are. Triggers keep them, so
-- every statement that changes a row changes them in its own transaction. A migration that makes one of the tables below anew loses
-- its triggers and has to make them again. The owner '' is nobody.

CREATE TABLE owner_totals (
    owner          TEXT PRIMARY KEY,
    -- Jobs that are queued or running.
    active_jobs    INTEGER NOT NULL DEFAULT 0,
    -- Bytes of the blobs in owner_blobs.
    stored_bytes   INTEGER NOT NULL DEFAULT 0,
    -- Bytes promised to uploads that have not ended.
    reserved_bytes INTEGER NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;

-- How often an owner's scenes, jobs, artifacts and exports refer to a blob.
CREATE TABLE owner_blobs (
    owner  TEXT NOT NULL,
    digest TEXT NOT NULL,
    uses   INTEGER NOT NULL,
    PRIMARY KEY (owner, digest)
) STRICT, WITHOUT ROWID;

-- Counts of what is stored: 'jobs' and 'deliveries' by state, 'blobs', 'blob_bytes'.
CREATE TABLE totals (
    name  TEXT NOT NULL,
    label TEXT NOT NULL DEFAULT '',
    value INTEGER NOT NULL,
    PRIMARY KEY (name, label)
) STRICT, WITHOUT ROWID;

-- Counts of what has happened, which never fall: 'claims', 'attempts_ended' by outcome and type of problem, 'phase_seconds' by phase.
CREATE TABLE counters (
    name  TEXT NOT NULL,
    label TEXT NOT NULL DEFAULT '',
    cause TEXT NOT NULL DEFAULT '',
    value REAL NOT NULL,
    PRIMARY KEY (name, label, cause)
) STRICT, WITHOUT ROWID;

-- What there is already.

INSERT INTO owner_blobs (owner, digest, uses)
SELECT owner, digest, count(*) FROM (
    SELECT IFNULL(owner, '') AS owner, dataset AS digest FROM scenes
    UNION ALL SELECT IFNULL(owner, ''), dataset FROM jobs
    UNION ALL SELECT IFNULL(jobs.owner, ''), artifacts.digest FROM artifacts JOIN jobs ON jobs.id = artifacts.job_id
    UNION ALL SELECT IFNULL(jobs.owner, ''), exports.digest FROM exports JOIN jobs ON jobs.id = exports.job_id
) GROUP BY owner, digest;

INSERT INTO owner_totals (owner, active_jobs, stored_bytes, reserved_bytes)
SELECT owner,
    (SELECT count(*) FROM jobs WHERE IFNULL(jobs.owner, '') = owners.owner AND state IN ('queued', 'running')),
    (SELECT IFNULL(sum(bytes), 0) FROM owner_blobs JOIN blobs USING (digest) WHERE owner_blobs.owner = owners.owner),
    (SELECT IFNULL(sum(length), 0) FROM uploads WHERE IFNULL(uploads.owner, '') = owners.owner AND ended_at IS NULL)
FROM (SELECT '' AS owner UNION SELECT id FROM keys) AS owners;

INSERT INTO totals (name, label, value)
SELECT 'jobs', column1, (SELECT count(*) FROM jobs WHERE state = column1)
FROM (VALUES ('queued'), ('running'), ('succeeded'), ('failed'), ('cancelled'));
INSERT INTO totals (name, label, value)
SELECT 'deliveries', column1, (SELECT count(*) FROM webhook_deliveries WHERE state = column1)
FROM (VALUES ('pending'), ('delivered'), ('failed'));
INSERT INTO totals (name, value) SELECT 'blobs', count(*) FROM blobs;
INSERT INTO totals (name, value) SELECT 'blob_bytes', IFNULL(sum(bytes), 0) FROM blobs;

INSERT INTO counters (name, value) SELECT 'claims', count(*) FROM attempts;
INSERT INTO counters (name, label, cause, value)
SELECT 'attempts_ended', outcome, IFNULL(json_extract(cause, '$.type'), ''), count(*)
FROM attempts WHERE outcome IS NOT NULL GROUP BY 2, 3;
INSERT INTO counters (name, label, value)
SELECT 'phase_seconds', column1, (SELECT total(json_extract(metrics, '$.seconds.' || column1)) FROM jobs WHERE metrics IS NOT NULL)
FROM (VALUES ('ingest'), ('train'), ('encode'), ('decode'));

-- Blobs of owners. Whoever is deleted takes its artifacts and exports along while its owner is still known.

CREATE TRIGGER owner_blobs_added AFTER INSERT ON owner_blobs BEGIN
    INSERT INTO owner_totals (owner, stored_bytes)
    VALUES (NEW.owner, (SELECT bytes FROM blobs WHERE digest = NEW.digest))
    ON CONFLICT (owner) DO UPDATE SET stored_bytes = stored_bytes + excluded.stored_bytes;
END;
CREATE TRIGGER owner_blobs_unused AFTER UPDATE OF uses ON owner_blobs WHEN NEW.uses = 0 BEGIN
    DELETE FROM owner_blobs WHERE owner = NEW.owner AND digest = NEW.digest;
END;
CREATE TRIGGER owner_blobs_removed AFTER DELETE ON owner_blobs BEGIN
    UPDATE owner_totals SET stored_bytes = stored_bytes - (SELECT bytes FROM blobs WHERE digest = OLD.digest)
    WHERE owner = OLD.owner;
END;

CREATE TRIGGER scenes_added AFTER INSERT ON scenes BEGIN
    INSERT INTO owner_blobs (owner, digest, uses) VALUES (IFNULL(NEW.owner, ''), NEW.dataset, 1)
    ON CONFLICT (owner, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER scenes_removed AFTER DELETE ON scenes BEGIN
    UPDATE owner_blobs SET uses = uses - 1 WHERE owner = IFNULL(OLD.owner, '') AND digest = OLD.dataset;
END;

CREATE TRIGGER artifacts_added AFTER INSERT ON artifacts BEGIN
    INSERT INTO owner_blobs (owner, digest, uses) SELECT IFNULL(owner, ''), NEW.digest, 1 FROM jobs WHERE id = NEW.job_id
    ON CONFLICT (owner, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER artifacts_removed AFTER DELETE ON artifacts BEGIN
    UPDATE owner_blobs SET uses = uses - 1
    WHERE digest = OLD.digest AND owner = (SELECT IFNULL(owner, '') FROM jobs WHERE id = OLD.job_id);
END;

CREATE TRIGGER exports_added AFTER INSERT ON exports BEGIN
    INSERT INTO owner_blobs (owner, digest, uses) SELECT IFNULL(owner, ''), NEW.digest, 1 FROM jobs WHERE id = NEW.job_id
    ON CONFLICT (owner, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER exports_removed AFTER DELETE ON exports BEGIN
    UPDATE owner_blobs SET uses = uses - 1
    WHERE digest = OLD.digest AND owner = (SELECT IFNULL(owner, '') FROM jobs WHERE id = OLD.job_id);
END;

-- Jobs.

CREATE TRIGGER jobs_added AFTER INSERT ON jobs BEGIN
    INSERT INTO owner_blobs (owner, digest, uses) VALUES (IFNULL(NEW.owner, ''), NEW.dataset, 1)
    ON CONFLICT (owner, digest) DO UPDATE SET uses = uses + 1;
    UPDATE owner_totals SET active_jobs = active_jobs + (NEW.state IN ('queued', 'running'))
    WHERE owner = IFNULL(NEW.owner, '');
    UPDATE totals SET value = value + 1 WHERE name = 'jobs' AND label = NEW.state;
END;
CREATE TRIGGER jobs_changed AFTER UPDATE OF state ON jobs WHEN OLD.state <> NEW.state BEGIN
    UPDATE owner_totals
    SET active_jobs = active_jobs + (NEW.state IN ('queued', 'running')) - (OLD.state IN ('queued', 'running'))
    WHERE owner = IFNULL(NEW.owner, '');
    UPDATE totals SET value = value + iif(label = NEW.state, 1, -1)
    WHERE name = 'jobs' AND label IN (OLD.state, NEW.state);
END;
CREATE TRIGGER jobs_removing BEFORE DELETE ON jobs BEGIN
    DELETE FROM artifacts WHERE job_id = OLD.id;
    DELETE FROM exports WHERE job_id = OLD.id;
END;
CREATE TRIGGER jobs_removed AFTER DELETE ON jobs BEGIN
    UPDATE owner_blobs SET uses = uses - 1 WHERE owner = IFNULL(OLD.owner, '') AND digest = OLD.dataset;
    UPDATE owner_totals SET active_jobs = active_jobs - (OLD.state IN ('queued', 'running'))
    WHERE owner = IFNULL(OLD.owner, '');
    UPDATE totals SET value = value - 1 WHERE name = 'jobs' AND label = OLD.state;
END;
CREATE TRIGGER jobs_measured AFTER UPDATE OF metrics ON jobs WHEN OLD.metrics IS NULL AND NEW.metrics IS NOT NULL BEGIN
    UPDATE counters SET value = value + IFNULL(json_extract(NEW.metrics, '$.seconds.' || label), 0)
    WHERE name = 'phase_seconds';
END;

CREATE TRIGGER attempts_added AFTER INSERT ON attempts BEGIN
    UPDATE counters SET value = value + 1 WHERE name = 'claims';
END;
CREATE TRIGGER attempts_ended AFTER UPDATE OF outcome ON attempts WHEN OLD.outcome IS NULL AND NEW.outcome IS NOT NULL BEGIN
    INSERT INTO counters (name, label, cause, value)
    VALUES ('attempts_ended', NEW.outcome, IFNULL(json_extract(NEW.cause, '$.type'), ''), 1)
    ON CONFLICT (name, label, cause) DO UPDATE SET value = value + 1;
END;

-- Uploads.

CREATE TRIGGER uploads_added AFTER INSERT ON uploads WHEN NEW.ended_at IS NULL BEGIN
    INSERT INTO owner_totals (owner, reserved_bytes) VALUES (IFNULL(NEW.owner, ''), NEW.length)
    ON CONFLICT (owner) DO UPDATE SET reserved_bytes = reserved_bytes + excluded.reserved_bytes;
END;
CREATE TRIGGER uploads_ended AFTER UPDATE OF ended_at ON uploads WHEN (OLD.ended_at IS NULL) <> (NEW.ended_at IS NULL) BEGIN
    UPDATE owner_totals SET reserved_bytes = reserved_bytes + iif(NEW.ended_at IS NULL, NEW.length, -NEW.length)
    WHERE owner = IFNULL(NEW.owner, '');
END;
CREATE TRIGGER uploads_removed AFTER DELETE ON uploads WHEN OLD.ended_at IS NULL BEGIN
    UPDATE owner_totals SET reserved_bytes = reserved_bytes - OLD.length WHERE owner = IFNULL(OLD.owner, '');
END;

-- Blobs and deliveries.

CREATE TRIGGER blobs_added AFTER INSERT ON blobs BEGIN
    UPDATE totals SET value = value + iif(name = 'blobs', 1, NEW.bytes) WHERE name IN ('blobs', 'blob_bytes');
END;
CREATE TRIGGER blobs_removed AFTER DELETE ON blobs BEGIN
    UPDATE totals SET value = value - iif(name = 'blobs', 1, OLD.bytes) WHERE name IN ('blobs', 'blob_bytes');
END;

CREATE TRIGGER deliveries_added AFTER INSERT ON webhook_deliveries BEGIN
    UPDATE totals SET value = value + 1 WHERE name = 'deliveries' AND label = NEW.state;
END;
CREATE TRIGGER deliveries_changed AFTER UPDATE OF state ON webhook_deliveries WHEN OLD.state <> NEW.state BEGIN
    UPDATE totals SET value = value + iif(label = NEW.state, 1, -1)
    WHERE name = 'deliveries' AND label IN (OLD.state, NEW.state);
END;
CREATE TRIGGER deliveries_removed AFTER DELETE ON webhook_deliveries BEGIN
    UPDATE totals SET value = value - 1 WHERE name = 'deliveries' AND label = OLD.state;
END;
