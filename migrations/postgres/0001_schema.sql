-- The same tables as SQLite's schema of version 17, whose migrations tell of their history. Instants are whole microseconds since
-- 1970-01-01T00:00:00Z. Documents are JSON text. Identities and names compare by their bytes, as in SQLite.
--
-- Two things differ. Totals of the whole service would be rows that every transaction locks, so their changes are rows of their own, which
-- fold_changes() adds up now and then. And the numbers of claims come from a sequence.

CREATE TABLE projects (
    id               TEXT COLLATE "C" PRIMARY KEY,
    name             TEXT NOT NULL,
    max_bytes        BIGINT CHECK (max_bytes >= 0),
    max_active_jobs  BIGINT CHECK (max_active_jobs >= 0),
    max_running_jobs BIGINT CHECK (max_running_jobs >= 0),
    max_priority     BIGINT CHECK (max_priority BETWEEN -100 AND 100),
    version          BIGINT NOT NULL DEFAULT 1,
    created_at       BIGINT NOT NULL
);

-- Whoever changes what a project has or may do locks its row here first.
CREATE TABLE project_totals (
    project        TEXT COLLATE "C" PRIMARY KEY REFERENCES projects (id) ON DELETE CASCADE,
    queued_jobs    BIGINT NOT NULL DEFAULT 0,
    running_jobs   BIGINT NOT NULL DEFAULT 0,
    succeeded_jobs BIGINT NOT NULL DEFAULT 0,
    failed_jobs    BIGINT NOT NULL DEFAULT 0,
    cancelled_jobs BIGINT NOT NULL DEFAULT 0,
    -- Bytes of the blobs in project_blobs, by their kind.
    dataset_bytes  BIGINT NOT NULL DEFAULT 0,
    artifact_bytes BIGINT NOT NULL DEFAULT 0,
    export_bytes   BIGINT NOT NULL DEFAULT 0,
    -- Bytes promised to uploads that have not ended.
    reserved_bytes BIGINT NOT NULL DEFAULT 0,
    -- How long ended attempts had a worker, with its processor and adapter, in microseconds. Never falls.
    worker_micros  BIGINT NOT NULL DEFAULT 0,
    -- The number of the latest claim of one of its jobs, which decides whose turn is next; 0 once none is queued or running.
    last_claim     BIGINT NOT NULL DEFAULT 0
) WITH (fillfactor = 50);

CREATE INDEX project_totals_queued ON project_totals (project) WHERE queued_jobs > 0;

CREATE TABLE keys (
    id                  TEXT COLLATE "C" PRIMARY KEY,
    project             TEXT COLLATE "C" NOT NULL REFERENCES projects (id),
    name                TEXT NOT NULL,
    -- What may be shown of the key: enough to tell it from others.
    prefix              TEXT NOT NULL,
    -- SHA-256 of the whole key, in hex. The key itself is nowhere.
    hash                TEXT COLLATE "C" NOT NULL UNIQUE,
    scopes              TEXT NOT NULL,
    requests_per_minute BIGINT CHECK (requests_per_minute > 0),
    created_at          BIGINT NOT NULL,
    last_used_at        BIGINT,
    expires_at          BIGINT,
    revoked_at          BIGINT
);

CREATE INDEX keys_by_project ON keys (project, id);

CREATE TABLE blobs (
    digest     TEXT COLLATE "C" PRIMARY KEY,
    bytes      BIGINT NOT NULL CHECK (bytes >= 0),
    created_at BIGINT NOT NULL
);

-- How often a project's scenes, jobs, artifacts and exports refer to a blob.
CREATE TABLE project_blobs (
    project TEXT COLLATE "C" NOT NULL,
    digest  TEXT COLLATE "C" NOT NULL,
    uses    BIGINT NOT NULL,
    kind    TEXT NOT NULL CHECK (kind IN ('dataset', 'artifact', 'export')),
    PRIMARY KEY (project, digest)
);

-- A dataset that jobs can be made of. Its archive is a blob, stored once however often it is sent.
CREATE TABLE scenes (
    id         TEXT COLLATE "C" PRIMARY KEY,
    project    TEXT COLLATE "C" NOT NULL REFERENCES projects (id),
    dataset    TEXT COLLATE "C" NOT NULL REFERENCES blobs (digest),
    name       TEXT,
    -- What the check of its structure found.
    summary    TEXT NOT NULL,
    version    BIGINT NOT NULL DEFAULT 1,
    created_at BIGINT NOT NULL
);

CREATE INDEX scenes_by_age ON scenes (created_at, id);
CREATE INDEX scenes_by_dataset ON scenes (dataset);
CREATE UNIQUE INDEX scenes_of_a_project ON scenes (project, dataset);
CREATE INDEX scenes_by_project ON scenes (project, created_at, id);

CREATE TABLE jobs (
    id                  TEXT COLLATE "C" PRIMARY KEY,
    project             TEXT COLLATE "C" NOT NULL REFERENCES projects (id),
    -- The key that made it.
    owner               TEXT COLLATE "C" REFERENCES keys (id),
    -- What its user calls it, and what its user notes about it: a JSON object of strings.
    name                TEXT COLLATE "C",
    metadata            TEXT NOT NULL DEFAULT '{}',
    -- The scene that it was made of, if it was not sent with its own archive.
    scene               TEXT COLLATE "C" REFERENCES scenes (id) ON DELETE SET NULL,
    -- The job that it repeats, and whether it may go on from where that one stopped.
    retry_of            TEXT COLLATE "C" REFERENCES jobs (id) ON DELETE SET NULL,
    from_checkpoint     BOOLEAN NOT NULL DEFAULT false,
    dataset             TEXT COLLATE "C" NOT NULL REFERENCES blobs (digest),
    options             TEXT NOT NULL,
    state               TEXT COLLATE "C" NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    phase               TEXT NOT NULL,
    progress            TEXT NOT NULL,
    metrics             TEXT,
    error               TEXT,
    priority            BIGINT NOT NULL,
    run_after           BIGINT NOT NULL,
    -- When a queued job began to wait until run_after. A clock that shows less has been set back since.
    waits_since         BIGINT NOT NULL DEFAULT 0,
    -- When it is to be given up, finished or not.
    deadline_at         BIGINT,
    -- How many times the job was begun. It fences: a worker's write must name the attempt that it was given.
    attempt             BIGINT NOT NULL DEFAULT 0,
    -- How many of those count against max_attempts; a graceful release gives its charge back.
    charged             BIGINT NOT NULL DEFAULT 0,
    max_attempts        BIGINT NOT NULL CHECK (max_attempts > 0),
    -- Attempts in a row whose worker died alone, and those that ended with the service, without a newer checkpoint.
    silent_deaths       BIGINT NOT NULL DEFAULT 0,
    setbacks            BIGINT NOT NULL DEFAULT 0 CHECK (setbacks >= 0),
    -- The step of the newest checkpoint that an attempt reported, and what that was when the latest attempt ended.
    checkpoint_step     BIGINT NOT NULL DEFAULT 0 CHECK (checkpoint_step >= 0),
    setback_step        BIGINT NOT NULL DEFAULT 0 CHECK (setback_step >= 0),
    lease_owner         TEXT,
    lease_until         BIGINT,
    cancel_requested_at BIGINT,
    progress_event_at   BIGINT,
    last_seq            BIGINT NOT NULL DEFAULT 0,
    version             BIGINT NOT NULL DEFAULT 1,
    created_at          BIGINT NOT NULL,
    started_at          BIGINT,
    finished_at         BIGINT,
    CHECK ((state = 'running') = (lease_owner IS NOT NULL)),
    CHECK ((state = 'running') = (lease_until IS NOT NULL)),
    CHECK ((state IN ('succeeded', 'failed', 'cancelled')) = (finished_at IS NOT NULL))
);

CREATE INDEX jobs_to_claim ON jobs (project, priority DESC, created_at, id) WHERE state = 'queued';
CREATE INDEX jobs_by_lease ON jobs (lease_owner) WHERE state = 'running';
CREATE INDEX jobs_running ON jobs (project) WHERE state = 'running';
CREATE INDEX jobs_by_age ON jobs (created_at, id);
CREATE INDEX jobs_by_project ON jobs (project, created_at, id);
CREATE INDEX jobs_by_project_state ON jobs (project, state, created_at, id);
CREATE INDEX jobs_by_project_name ON jobs (project, name, created_at, id) WHERE name IS NOT NULL;
CREATE INDEX jobs_by_name ON jobs (name, created_at, id) WHERE name IS NOT NULL;
CREATE INDEX jobs_by_scene ON jobs (scene, created_at, id) WHERE scene IS NOT NULL;
CREATE INDEX jobs_active_by_scene ON jobs (scene) WHERE state IN ('queued', 'running');
CREATE INDEX jobs_by_dataset ON jobs (dataset);
CREATE INDEX jobs_by_retry ON jobs (retry_of) WHERE retry_of IS NOT NULL;
CREATE INDEX jobs_queued_by_age ON jobs (created_at) WHERE state = 'queued';
CREATE INDEX jobs_by_deadline ON jobs (deadline_at) WHERE deadline_at IS NOT NULL AND state = 'queued';

CREATE TABLE attempts (
    job_id     TEXT COLLATE "C" NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    number     BIGINT NOT NULL,
    worker     TEXT NOT NULL,
    started_at BIGINT NOT NULL,
    ended_at   BIGINT,
    outcome    TEXT CHECK (outcome IN ('succeeded', 'failed', 'retried', 'cancelled', 'released', 'lost')),
    cause      TEXT,
    PRIMARY KEY (job_id, number),
    CHECK ((ended_at IS NULL) = (outcome IS NULL))
);

CREATE TABLE events (
    job_id  TEXT COLLATE "C" NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    seq     BIGINT NOT NULL CHECK (seq > 0),
    at      BIGINT NOT NULL,
    kind    TEXT NOT NULL,
    attempt BIGINT NOT NULL,
    data    TEXT NOT NULL,
    PRIMARY KEY (job_id, seq)
);

CREATE TABLE artifacts (
    job_id  TEXT COLLATE "C" NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT COLLATE "C" NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out')),
    -- The place in the order in which they were published; 0 is the one that is meant where none is named.
    place   BIGINT NOT NULL CHECK (place >= 0),
    lambda  DOUBLE PRECISION,
    digest  TEXT COLLATE "C" NOT NULL REFERENCES blobs (digest),
    attempt BIGINT NOT NULL,
    PRIMARY KEY (job_id, kind, place)
);

CREATE INDEX artifacts_by_digest ON artifacts (digest);

-- Finished scenes in formats that other programs read, made when first asked for.
CREATE TABLE exports (
    job_id         TEXT COLLATE "C" NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    -- The artifact that it was made of.
    source         TEXT COLLATE "C" NOT NULL REFERENCES blobs (digest),
    format         TEXT COLLATE "C" NOT NULL CHECK (format IN ('ply', 'spz', 'spz3')),
    digest         TEXT COLLATE "C" NOT NULL REFERENCES blobs (digest),
    gaussians      BIGINT NOT NULL CHECK (gaussians >= 0),
    sh_degree      BIGINT NOT NULL CHECK (sh_degree BETWEEN 0 AND 3),
    created_at     BIGINT NOT NULL,
    -- How alike pictures of the export and of the scene are; both or neither is known.
    likeness_psnr  DOUBLE PRECISION,
    likeness_views BIGINT CHECK (likeness_views > 0),
    CHECK ((likeness_psnr IS NULL) = (likeness_views IS NULL)),
    PRIMARY KEY (job_id, source, format)
);

CREATE INDEX exports_by_digest ON exports (digest);
CREATE INDEX exports_by_source ON exports (source);

-- Archives that come in parts (tus). Their bytes are files of their own until a scene is made of them.
CREATE TABLE uploads (
    id         TEXT COLLATE "C" PRIMARY KEY,
    project    TEXT COLLATE "C" NOT NULL REFERENCES projects (id),
    -- At most a pebibyte, so that no sum of lengths overflows.
    length     BIGINT NOT NULL CHECK (length BETWEEN 0 AND 1125899906842624),
    -- How many bytes are surely on disk; never more than the file holds.
    received   BIGINT NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND length),
    -- Upload-Metadata as it was sent.
    metadata   TEXT,
    -- The scene that was made of it.
    scene      TEXT COLLATE "C" REFERENCES scenes (id) ON DELETE SET NULL,
    created_at BIGINT NOT NULL,
    expires_at BIGINT NOT NULL,
    -- When it ceased to take bytes and to count against its project's room: used or expired. The row stays for a while to say so.
    ended_at   BIGINT
);

CREATE INDEX uploads_open ON uploads (expires_at) WHERE ended_at IS NULL;
CREATE INDEX uploads_ended ON uploads (ended_at) WHERE ended_at IS NOT NULL;
CREATE INDEX uploads_by_project ON uploads (project);
CREATE INDEX uploads_by_scene ON uploads (scene) WHERE scene IS NOT NULL;

-- What requests with an Idempotency-Key made, written with what they made. A request that is still being answered has no row,
-- so one that a crash cut off stands in nobody's way.
CREATE TABLE idempotency (
    project     TEXT COLLATE "C" NOT NULL,
    key         TEXT COLLATE "C" NOT NULL,
    fingerprint TEXT NOT NULL,
    status      BIGINT NOT NULL,
    -- What was made: its identity.
    resource    TEXT NOT NULL,
    created_at  BIGINT NOT NULL,
    PRIMARY KEY (project, key)
);

CREATE INDEX idempotency_by_age ON idempotency (created_at);

-- How a job's training went: at most one point for each thousandth of it, the latest there.
CREATE TABLE series (
    job_id    TEXT COLLATE "C" NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    bucket    BIGINT NOT NULL CHECK (bucket BETWEEN 0 AND 999),
    attempt   BIGINT NOT NULL,
    step      BIGINT NOT NULL,
    -- Since the attempt began.
    seconds   DOUBLE PRECISION NOT NULL,
    loss      DOUBLE PRECISION,
    psnr      DOUBLE PRECISION,
    ssim      DOUBLE PRECISION,
    anchors   BIGINT NOT NULL,
    gaussians BIGINT NOT NULL,
    bytes     BIGINT,
    PRIMARY KEY (job_id, bucket)
);

-- Where a project wants to be told of its jobs.
CREATE TABLE webhook_endpoints (
    id          TEXT COLLATE "C" PRIMARY KEY,
    project     TEXT COLLATE "C" NOT NULL REFERENCES projects (id),
    url         TEXT NOT NULL,
    -- Names of the events that it wants, as a JSON array.
    events      TEXT NOT NULL,
    description TEXT,
    -- What signs is needed in clear at every delivery, so it cannot be hashed as keys are.
    secret      TEXT NOT NULL,
    created_at  BIGINT NOT NULL,
    -- When it answered that it is gone.
    disabled_at BIGINT
);

CREATE INDEX webhook_endpoints_by_project ON webhook_endpoints (project);

-- The outbox: a row is written in the transaction of the change that it tells of.
CREATE TABLE webhook_deliveries (
    seq           BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id            TEXT COLLATE "C" NOT NULL UNIQUE,
    endpoint      TEXT COLLATE "C" NOT NULL REFERENCES webhook_endpoints (id) ON DELETE CASCADE,
    -- Kept when the job is deleted.
    job           TEXT NOT NULL,
    event         TEXT NOT NULL,
    body          TEXT NOT NULL,
    state         TEXT NOT NULL CHECK (state IN ('pending', 'delivered', 'failed')),
    -- All that were ever begun. It fences: an outcome must name the attempt that it is of.
    attempts      BIGINT NOT NULL DEFAULT 0,
    -- Those since the delivery was made or last asked for again; its place in the schedule.
    tries         BIGINT NOT NULL DEFAULT 0,
    due_at        BIGINT,
    lease_until   BIGINT,
    created_at    BIGINT NOT NULL,
    attempted_at  BIGINT,
    delivered_at  BIGINT,
    -- What the latest attempt came to.
    answer_status BIGINT,
    answer_fault  TEXT,
    CHECK ((state = 'pending') = (due_at IS NOT NULL)),
    CHECK (state = 'pending' OR lease_until IS NULL),
    CHECK ((state = 'delivered') = (delivered_at IS NOT NULL))
);

CREATE INDEX webhook_deliveries_due ON webhook_deliveries (due_at, seq) WHERE state = 'pending';
CREATE INDEX webhook_deliveries_under_way ON webhook_deliveries (endpoint) WHERE lease_until IS NOT NULL;
CREATE INDEX webhook_deliveries_by_endpoint ON webhook_deliveries (endpoint, seq);
CREATE INDEX webhook_deliveries_by_age ON webhook_deliveries (created_at) WHERE state <> 'pending';

-- What is written to find out whether anything can be: one row, which says when that was last done.
CREATE TABLE write_probe (
    id BIGINT PRIMARY KEY CHECK (id = 1),
    at BIGINT NOT NULL
);

-- Counts of what is stored: 'deliveries' by state, 'blobs', 'blob_bytes'. Those of jobs are the sums of project_totals.
CREATE TABLE totals (
    name  TEXT COLLATE "C" NOT NULL,
    label TEXT COLLATE "C" NOT NULL DEFAULT '',
    value BIGINT NOT NULL,
    PRIMARY KEY (name, label)
);

CREATE TABLE total_changes (
    name  TEXT COLLATE "C" NOT NULL,
    label TEXT COLLATE "C" NOT NULL DEFAULT '',
    value BIGINT NOT NULL
);

-- Counts of what has happened, which never fall: 'claims', 'attempts_ended' by outcome and type of problem, 'phase_seconds' by phase.
CREATE TABLE counters (
    name  TEXT COLLATE "C" NOT NULL,
    label TEXT COLLATE "C" NOT NULL DEFAULT '',
    cause TEXT COLLATE "C" NOT NULL DEFAULT '',
    value DOUBLE PRECISION NOT NULL,
    PRIMARY KEY (name, label, cause)
);

CREATE TABLE counter_changes (
    name  TEXT COLLATE "C" NOT NULL,
    label TEXT COLLATE "C" NOT NULL DEFAULT '',
    cause TEXT COLLATE "C" NOT NULL DEFAULT '',
    value DOUBLE PRECISION NOT NULL
);

CREATE SEQUENCE claim_numbers;

-- Adds the changes to what they change. One at a time; another does nothing.
CREATE FUNCTION fold_changes() RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    IF NOT pg_try_advisory_xact_lock(7203481) THEN
        RETURN;
    END IF;
    WITH gone AS (DELETE FROM total_changes RETURNING name, label, value)
    INSERT INTO totals AS kept (name, label, value) SELECT name, label, SUM(value) FROM gone GROUP BY name, label
    ON CONFLICT (name, label) DO UPDATE SET value = kept.value + excluded.value;
    WITH gone AS (DELETE FROM counter_changes RETURNING name, label, cause, value)
    INSERT INTO counters AS kept (name, label, cause, value)
    SELECT name, label, cause, SUM(value) FROM gone GROUP BY name, label, cause
    ON CONFLICT (name, label, cause) DO UPDATE SET value = kept.value + excluded.value;
END $$;

-- Totals of projects.

CREATE FUNCTION projects_added() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO project_totals (project) VALUES (NEW.id);
    RETURN NULL;
END $$;
CREATE TRIGGER projects_added AFTER INSERT ON projects FOR EACH ROW EXECUTE FUNCTION projects_added();

-- A project refers to a blob once more; the first kind of use is what its bytes count as.
CREATE FUNCTION use_blob(of_project TEXT, of_blob TEXT, of_kind TEXT) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO project_blobs AS kept (project, digest, uses, kind) VALUES (of_project, of_blob, 1, of_kind)
    ON CONFLICT (project, digest) DO UPDATE SET uses = kept.uses + 1;
END $$;

CREATE FUNCTION release_blob(of_project TEXT, of_blob TEXT) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    UPDATE project_blobs SET uses = uses - 1 WHERE project = of_project AND digest = of_blob;
    DELETE FROM project_blobs WHERE project = of_project AND digest = of_blob AND uses = 0;
END $$;

CREATE FUNCTION project_blobs_changed() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    changed project_blobs;
    size BIGINT;
BEGIN
    IF TG_OP = 'INSERT' THEN changed := NEW; ELSE changed := OLD; END IF;
    SELECT bytes INTO size FROM blobs WHERE digest = changed.digest;
    IF TG_OP = 'DELETE' THEN size := -size; END IF;
    UPDATE project_totals SET
        dataset_bytes = dataset_bytes + CASE changed.kind WHEN 'dataset' THEN size ELSE 0 END,
        artifact_bytes = artifact_bytes + CASE changed.kind WHEN 'artifact' THEN size ELSE 0 END,
        export_bytes = export_bytes + CASE changed.kind WHEN 'export' THEN size ELSE 0 END
    WHERE project = changed.project;
    RETURN NULL;
END $$;
CREATE TRIGGER project_blobs_changed AFTER INSERT OR DELETE ON project_blobs
    FOR EACH ROW EXECUTE FUNCTION project_blobs_changed();

CREATE FUNCTION scenes_changed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP = 'INSERT' THEN
        PERFORM use_blob(NEW.project, NEW.dataset, 'dataset');
    ELSE
        PERFORM release_blob(OLD.project, OLD.dataset);
    END IF;
    RETURN NULL;
END $$;
CREATE TRIGGER scenes_changed AFTER INSERT OR DELETE ON scenes FOR EACH ROW EXECUTE FUNCTION scenes_changed();

-- Of artifacts and exports; the argument is the kind of use.
CREATE FUNCTION files_changed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP = 'INSERT' THEN
        PERFORM use_blob(project, NEW.digest, TG_ARGV[0]) FROM jobs WHERE id = NEW.job_id;
    ELSE
        PERFORM release_blob(project, OLD.digest) FROM jobs WHERE id = OLD.job_id;
    END IF;
    RETURN NULL;
END $$;
CREATE TRIGGER artifacts_changed AFTER INSERT OR DELETE ON artifacts FOR EACH ROW EXECUTE FUNCTION files_changed('artifact');
CREATE TRIGGER exports_changed AFTER INSERT OR DELETE ON exports FOR EACH ROW EXECUTE FUNCTION files_changed('export');

-- Jobs. Whoever is deleted takes its artifacts and exports along while its project is still known.

CREATE FUNCTION jobs_removing() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    DELETE FROM artifacts WHERE job_id = OLD.id;
    DELETE FROM exports WHERE job_id = OLD.id;
    RETURN OLD;
END $$;
CREATE TRIGGER jobs_removing BEFORE DELETE ON jobs FOR EACH ROW EXECUTE FUNCTION jobs_removing();

-- One job more, or fewer, in a state.
CREATE FUNCTION count_job(of_project TEXT, of_state TEXT, more BIGINT) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    UPDATE project_totals SET
        queued_jobs = queued_jobs + CASE of_state WHEN 'queued' THEN more ELSE 0 END,
        running_jobs = running_jobs + CASE of_state WHEN 'running' THEN more ELSE 0 END,
        succeeded_jobs = succeeded_jobs + CASE of_state WHEN 'succeeded' THEN more ELSE 0 END,
        failed_jobs = failed_jobs + CASE of_state WHEN 'failed' THEN more ELSE 0 END,
        cancelled_jobs = cancelled_jobs + CASE of_state WHEN 'cancelled' THEN more ELSE 0 END
    WHERE project = of_project;
END $$;

CREATE FUNCTION jobs_added() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM use_blob(NEW.project, NEW.dataset, 'dataset');
    PERFORM count_job(NEW.project, NEW.state, 1);
    RETURN NULL;
END $$;
CREATE TRIGGER jobs_added AFTER INSERT ON jobs FOR EACH ROW EXECUTE FUNCTION jobs_added();

CREATE FUNCTION jobs_changed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM count_job(NEW.project, OLD.state, -1);
    PERFORM count_job(NEW.project, NEW.state, 1);
    UPDATE project_totals SET last_claim = 0 WHERE project = NEW.project AND queued_jobs + running_jobs = 0;
    RETURN NULL;
END $$;
CREATE TRIGGER jobs_changed AFTER UPDATE OF state ON jobs
    FOR EACH ROW WHEN (OLD.state <> NEW.state) EXECUTE FUNCTION jobs_changed();

CREATE FUNCTION jobs_removed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM release_blob(OLD.project, OLD.dataset);
    PERFORM count_job(OLD.project, OLD.state, -1);
    RETURN NULL;
END $$;
CREATE TRIGGER jobs_removed AFTER DELETE ON jobs FOR EACH ROW EXECUTE FUNCTION jobs_removed();

CREATE FUNCTION jobs_measured() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO counter_changes (name, label, value)
    SELECT 'phase_seconds', phases.name, seconds
    FROM (VALUES ('ingest'), ('train'), ('encode'), ('decode')) AS phases (name)
    CROSS JOIN LATERAL (
        SELECT CAST(CAST(NEW.metrics AS jsonb) -> 'seconds' ->> phases.name AS double precision)) AS found (seconds)
    WHERE seconds IS NOT NULL;
    RETURN NULL;
END $$;
CREATE TRIGGER jobs_measured AFTER UPDATE OF metrics ON jobs
    FOR EACH ROW WHEN (OLD.metrics IS NULL AND NEW.metrics IS NOT NULL) EXECUTE FUNCTION jobs_measured();

CREATE FUNCTION attempts_added() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO counter_changes (name, value) VALUES ('claims', 1);
    UPDATE project_totals SET last_claim = nextval('claim_numbers')
    WHERE project = (SELECT project FROM jobs WHERE id = NEW.job_id);
    RETURN NULL;
END $$;
CREATE TRIGGER attempts_added AFTER INSERT ON attempts FOR EACH ROW EXECUTE FUNCTION attempts_added();

CREATE FUNCTION attempts_ended() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO counter_changes (name, label, cause, value)
    VALUES ('attempts_ended', NEW.outcome, COALESCE(CAST(NEW.cause AS jsonb) ->> 'type', ''), 1);
    UPDATE project_totals SET worker_micros = worker_micros + GREATEST(0, NEW.ended_at - NEW.started_at)
    WHERE project = (SELECT project FROM jobs WHERE id = NEW.job_id);
    RETURN NULL;
END $$;
CREATE TRIGGER attempts_ended AFTER UPDATE OF outcome ON attempts
    FOR EACH ROW WHEN (OLD.outcome IS NULL AND NEW.outcome IS NOT NULL) EXECUTE FUNCTION attempts_ended();

-- Whoever listens is told when the transaction commits; equal messages of a transaction are sent once.

CREATE FUNCTION tell() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM pg_notify(TG_ARGV[0], '');
    RETURN NULL;
END $$;
CREATE TRIGGER jobs_added_told AFTER INSERT ON jobs FOR EACH STATEMENT EXECUTE FUNCTION tell('tcgs_queue');
-- It can be claimed again, or leaves room for another job of its project.
CREATE TRIGGER jobs_changed_told AFTER UPDATE OF state ON jobs
    FOR EACH ROW WHEN (OLD.state <> NEW.state AND (NEW.state = 'queued' OR OLD.state = 'running'))
    EXECUTE FUNCTION tell('tcgs_queue');
CREATE TRIGGER events_told AFTER INSERT ON events FOR EACH STATEMENT EXECUTE FUNCTION tell('tcgs_events');

-- Uploads.

CREATE FUNCTION uploads_changed() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    of_project TEXT;
    reserved BIGINT := 0;
BEGIN
    IF TG_OP <> 'INSERT' AND OLD.ended_at IS NULL THEN
        reserved := -OLD.length;
        of_project := OLD.project;
    END IF;
    IF TG_OP <> 'DELETE' AND NEW.ended_at IS NULL THEN
        reserved := reserved + NEW.length;
        of_project := NEW.project;
    END IF;
    IF reserved <> 0 THEN
        UPDATE project_totals SET reserved_bytes = reserved_bytes + reserved WHERE project = of_project;
    END IF;
    RETURN NULL;
END $$;
CREATE TRIGGER uploads_changed AFTER INSERT OR UPDATE OF ended_at OR DELETE ON uploads
    FOR EACH ROW EXECUTE FUNCTION uploads_changed();

-- Blobs and deliveries.

CREATE FUNCTION blobs_changed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP = 'INSERT' THEN
        INSERT INTO total_changes (name, value) VALUES ('blobs', 1), ('blob_bytes', NEW.bytes);
    ELSE
        INSERT INTO total_changes (name, value) VALUES ('blobs', -1), ('blob_bytes', -OLD.bytes);
    END IF;
    RETURN NULL;
END $$;
CREATE TRIGGER blobs_changed AFTER INSERT OR DELETE ON blobs FOR EACH ROW EXECUTE FUNCTION blobs_changed();

CREATE FUNCTION deliveries_changed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP <> 'INSERT' THEN
        INSERT INTO total_changes (name, label, value) VALUES ('deliveries', OLD.state, -1);
    END IF;
    IF TG_OP <> 'DELETE' THEN
        INSERT INTO total_changes (name, label, value) VALUES ('deliveries', NEW.state, 1);
    END IF;
    RETURN NULL;
END $$;
CREATE TRIGGER deliveries_changed AFTER INSERT OR UPDATE OF state OR DELETE ON webhook_deliveries
    FOR EACH ROW EXECUTE FUNCTION deliveries_changed();

INSERT INTO projects (id, name, created_at) VALUES ('00000000-0000-0000-0000-000000000000', 'default', 0);
