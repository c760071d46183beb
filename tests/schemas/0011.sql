PRAGMA foreign_keys=OFF;
BEGIN TRANSACTION;
CREATE TABLE _sqlx_migrations (
    version BIGINT PRIMARY KEY,
    description TEXT NOT NULL,
    installed_on TIMESTAMP NOT NULL DEFAULT CURRENT_TIMESTAMP,
    success BOOLEAN NOT NULL,
    checksum BLOB NOT NULL,
    execution_time BIGINT NOT NULL
);
INSERT INTO _sqlx_migrations VALUES(1,'queue','2026-11-22 00:00:00',1,X'60e652c7ddc7596bd55c2bb65dc6c1613a536cac773a1959fac183bfb3c3969d82e9d4502167c5e41cb48f1b6bec9f23',1000);
INSERT INTO _sqlx_migrations VALUES(2,'artifact kinds','2026-11-22 00:00:00',1,X'3f5f8814d83c7880ee8d84f166d6becec54a8116e4fb29e181f17d8975ec4287e94b9e9602d2de281f0ed9f1cfab23e5',1000);
INSERT INTO _sqlx_migrations VALUES(3,'curve artifacts','2026-11-22 00:00:00',1,X'e9c00975df3a32f1adc1e29ce24719b0f869ee53217bec43c429b4e2428185bc57ec586214a5c983c1ae795feff98818',1000);
INSERT INTO _sqlx_migrations VALUES(4,'owners and scenes','2026-11-22 00:00:00',1,X'84f5349ac4febc170184f3b1b06b3768d2dac804c5f4c771606ee9df3503c32b6187444a757be96a654cea6b5e3b3d7c',1000);
INSERT INTO _sqlx_migrations VALUES(5,'uploads','2026-11-22 00:00:00',1,X'7a0a1de5f54b195fe2c4596f700b62338ba3b8f9ad39eca4a11f8b6379cedd9d61c863ef394954f709b274750636a00f',1000);
INSERT INTO _sqlx_migrations VALUES(6,'idempotency exports','2026-11-22 00:00:00',1,X'16103169be6bdc1733f342f8de90636c1cfae8e9f74b776c19300d73ea391f3ea70b8f9a14878e171fe0c73b97a21c8d',1000);
INSERT INTO _sqlx_migrations VALUES(7,'series webhooks','2026-11-22 00:00:00',1,X'e89cab99f5074576a03004babce6555eb46567db49a11efd7599d2341f2c8dc1d7125a97d80dd5bd4c5cad429cbd7f79',1000);
INSERT INTO _sqlx_migrations VALUES(9,'held out views','2026-11-22 00:00:00',1,X'399fde53492e205f23d37fb40236ba92e168aabf6a8b9ebdea3d50b23d299e91dd7b27d7bf79c2a404cb644160005c43',1000);
INSERT INTO _sqlx_migrations VALUES(10,'export likeness','2026-11-22 00:00:00',1,X'79a4b9b44124b28ae5b541376d6614ea1ca02b700b84a5ac97969e2cc0c023d5750ee1456384b37eb91921feebc47ed8',1000);
INSERT INTO _sqlx_migrations VALUES(11,'running totals','2026-11-22 00:00:00',1,X'518911bc1d79279eefdde277723a526ff4b12362dd3269c5858f087eb78fd1273d83c36b11ed22df6bdd66487c461c01',1000);
CREATE TABLE IF NOT EXISTS "artifacts" (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out')),
    -- The place in the order in which they were published; 0 is the one that is meant where none is named.
    place   INTEGER NOT NULL CHECK (place >= 0),
    lambda  REAL,
    digest  TEXT NOT NULL REFERENCES blobs (digest),
    attempt INTEGER NOT NULL,
    PRIMARY KEY (job_id, kind, place)
) STRICT, WITHOUT ROWID;
INSERT INTO artifacts VALUES('01890a5d-ac96-774b-bcce-b302099a8057','tcgs',0,NULL,'bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb',1);
CREATE TABLE attempts (
    job_id     TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    number     INTEGER NOT NULL,
    worker     TEXT NOT NULL,
    started_at INTEGER NOT NULL,
    ended_at   INTEGER,
    outcome    TEXT CHECK (outcome IN ('succeeded', 'failed', 'retried', 'cancelled', 'released', 'lost')),
    cause      TEXT,
    PRIMARY KEY (job_id, number),
    CHECK ((ended_at IS NULL) = (outcome IS NULL))
) STRICT, WITHOUT ROWID;
INSERT INTO attempts VALUES('01890a5d-ac96-774b-bcce-b302099a8057',1,'a worker',6,7,'succeeded',NULL);
CREATE TABLE blobs (
    digest     TEXT PRIMARY KEY,
    bytes      INTEGER NOT NULL CHECK (bytes >= 0),
    created_at INTEGER NOT NULL
) STRICT;
INSERT INTO blobs VALUES('aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa',1000,5);
INSERT INTO blobs VALUES('bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb',77,5);
INSERT INTO blobs VALUES('eeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeee',90,5);
CREATE TABLE events (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    seq     INTEGER NOT NULL CHECK (seq > 0),
    at      INTEGER NOT NULL,
    kind    TEXT NOT NULL,
    attempt INTEGER NOT NULL,
    data    TEXT NOT NULL,
    PRIMARY KEY (job_id, seq)
) STRICT, WITHOUT ROWID;
INSERT INTO events VALUES('01890a5d-ac96-774b-bcce-b30200000003',1,5,'state',0,'{"state":"queued"}');
INSERT INTO events VALUES('01890a5d-ac96-774b-bcce-b302099a8057',1,5,'state',0,'{"state":"queued"}');
CREATE TABLE exports (
    job_id     TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    -- The artifact that it was made of.
    source     TEXT NOT NULL REFERENCES blobs (digest),
    format     TEXT NOT NULL CHECK (format IN ('ply', 'spz')),
    digest     TEXT NOT NULL REFERENCES blobs (digest),
    gaussians  INTEGER NOT NULL CHECK (gaussians >= 0),
    sh_degree  INTEGER NOT NULL CHECK (sh_degree BETWEEN 0 AND 3),
    created_at INTEGER NOT NULL, likeness_psnr REAL, likeness_views INTEGER
    CHECK (likeness_views > 0 AND (likeness_psnr IS NULL) = (likeness_views IS NULL)),
    PRIMARY KEY (job_id, source, format)
) STRICT, WITHOUT ROWID;
INSERT INTO exports VALUES('01890a5d-ac96-774b-bcce-b302099a8057','bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb','ply','eeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeee',20,3,8,41.25,3);
CREATE TABLE idempotency (
    -- The key's owner; empty for nobody, since two NULLs would be two owners.
    owner       TEXT NOT NULL,
    key         TEXT NOT NULL,
    fingerprint TEXT NOT NULL,
    status      INTEGER NOT NULL,
    -- What was made: its identity.
    resource    TEXT NOT NULL,
    created_at  INTEGER NOT NULL,
    PRIMARY KEY (owner, key)
) STRICT, WITHOUT ROWID;
INSERT INTO idempotency VALUES('01890a5d-ac96-774b-bcce-b30200000001','a request','ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff',201,'01890a5d-ac96-774b-bcce-b30200000003',5);
CREATE TABLE jobs (
    id                  TEXT PRIMARY KEY,
    dataset             TEXT NOT NULL REFERENCES blobs (digest),
    options             TEXT NOT NULL,
    state               TEXT NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    phase               TEXT NOT NULL,
    progress            TEXT NOT NULL,
    metrics             TEXT,
    error               TEXT,
    priority            INTEGER NOT NULL,
    run_after           INTEGER NOT NULL,
    -- How many times the job was begun. It fences: a worker's write must name the attempt that it was given.
    attempt             INTEGER NOT NULL DEFAULT 0,
    -- How many of those count against max_attempts; a graceful release gives its charge back.
    charged             INTEGER NOT NULL DEFAULT 0,
    max_attempts        INTEGER NOT NULL CHECK (max_attempts > 0),
    -- Consecutive attempts that ended without a word (the worker was killed).
    silent_deaths       INTEGER NOT NULL DEFAULT 0,
    lease_owner         TEXT,
    lease_until         INTEGER,
    cancel_requested_at INTEGER,
    progress_event_at   INTEGER,
    last_seq            INTEGER NOT NULL DEFAULT 0,
    version             INTEGER NOT NULL DEFAULT 1,
    created_at          INTEGER NOT NULL,
    started_at          INTEGER,
    finished_at         INTEGER, owner TEXT REFERENCES keys (id), scene TEXT REFERENCES scenes (id) ON DELETE SET NULL, deadline_at INTEGER, retry_of TEXT REFERENCES jobs (id) ON DELETE SET NULL, from_checkpoint INTEGER NOT NULL DEFAULT 0 CHECK (from_checkpoint IN (0, 1)),
    CHECK ((state = 'running') = (lease_owner IS NOT NULL)),
    CHECK ((state = 'running') = (lease_until IS NOT NULL)),
    CHECK ((state IN ('succeeded', 'failed', 'cancelled')) = (finished_at IS NOT NULL))
) STRICT;
INSERT INTO jobs VALUES('01890a5d-ac96-774b-bcce-b302099a8057','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','succeeded','done','{}','{"test":{"psnr":30.5,"ssim":0.97,"lpips":null,"views":3},"train":{"psnr":31.0,"ssim":0.98,"lpips":null,"views":9},"bytes":{"total":77,"positions":1,"networks":2,"planes":0,"masks":3,"features":4,"scalings":5,"offsets":6,"container":56},"seconds":{"ingest":1.0,"train":60.0,"encode":0.5,"decode":0.1},"steps":400,"steps_per_second":6.5,"anchors":10,"gaussians":20,"psnr_before_quantisation":30.6,"adapter":"llvmpipe","background":"black","decode_sha256":"cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc"}',NULL,0,5,1,1,3,0,NULL,NULL,NULL,NULL,1,1,5,6,7,NULL,NULL,NULL,NULL,0);
INSERT INTO jobs VALUES('01890a5d-ac96-774b-bcce-b30200000003','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','queued','queued','{}',NULL,NULL,0,5,0,0,3,0,NULL,NULL,NULL,NULL,1,1,8,NULL,NULL,'01890a5d-ac96-774b-bcce-b30200000001','01890a5d-ac96-774b-bcce-b30200000002',NULL,NULL,0);
CREATE TABLE keys (
    id                  TEXT PRIMARY KEY,
    name                TEXT NOT NULL,
    -- What may be shown of the key: enough to tell it from others.
    prefix              TEXT NOT NULL,
    -- SHA-256 of the whole key, in hex. The key itself is nowhere.
    hash                TEXT NOT NULL UNIQUE,
    scopes              TEXT NOT NULL,
    max_bytes           INTEGER CHECK (max_bytes >= 0),
    max_active_jobs     INTEGER CHECK (max_active_jobs >= 0),
    requests_per_minute INTEGER CHECK (requests_per_minute > 0),
    created_at          INTEGER NOT NULL,
    last_used_at        INTEGER,
    revoked_at          INTEGER
) STRICT;
INSERT INTO keys VALUES('01890a5d-ac96-774b-bcce-b30200000001','a key','tcgs_0123','dddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddd','read jobs:write',NULL,NULL,NULL,5,NULL,NULL);
CREATE TABLE scenes (
    id         TEXT PRIMARY KEY,
    owner      TEXT REFERENCES keys (id),
    dataset    TEXT NOT NULL REFERENCES blobs (digest),
    name       TEXT,
    -- What the check of its structure found.
    summary    TEXT NOT NULL,
    version    INTEGER NOT NULL DEFAULT 1,
    created_at INTEGER NOT NULL
) STRICT;
INSERT INTO scenes VALUES('01890a5d-ac96-774b-bcce-b30200000002','01890a5d-ac96-774b-bcce-b30200000001','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','a scene','{"layout":"blender","train":9,"test":3,"pixels":12000,"points":null,"notes":[]}',1,5);
CREATE TABLE series (
    job_id    TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    bucket    INTEGER NOT NULL CHECK (bucket BETWEEN 0 AND 999),
    attempt   INTEGER NOT NULL,
    step      INTEGER NOT NULL,
    -- Since the attempt began.
    seconds   REAL NOT NULL,
    loss      REAL,
    psnr      REAL,
    anchors   INTEGER NOT NULL,
    gaussians INTEGER NOT NULL,
    bytes     INTEGER,
    PRIMARY KEY (job_id, bucket)
) STRICT, WITHOUT ROWID;
INSERT INTO series VALUES('01890a5d-ac96-774b-bcce-b302099a8057',999,1,400,60.0,0.010000000000000000208,31.0,10,20,80);
CREATE TABLE uploads (
    id         TEXT PRIMARY KEY,
    owner      TEXT REFERENCES keys (id),
    -- At most a pebibyte, so that no sum of lengths overflows.
    length     INTEGER NOT NULL CHECK (length BETWEEN 0 AND 1125899906842624),
    -- How many bytes are surely on disk; never more than the file holds.
    received   INTEGER NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND length),
    -- Upload-Metadata as it was sent.
    metadata   TEXT,
    -- The scene that was made of it.
    scene      TEXT REFERENCES scenes (id) ON DELETE SET NULL,
    created_at INTEGER NOT NULL,
    expires_at INTEGER NOT NULL,
    -- When it ceased to take bytes and to count against its owner's room: used or expired. The row stays for a while to say so.
    ended_at   INTEGER
) STRICT;
INSERT INTO uploads VALUES('01890a5d-ac96-774b-bcce-b30200000004','01890a5d-ac96-774b-bcce-b30200000001',100,40,NULL,NULL,5,9000000000000000,NULL);
CREATE TABLE webhook_deliveries (
    seq           INTEGER PRIMARY KEY AUTOINCREMENT,
    id            TEXT NOT NULL UNIQUE,
    endpoint      TEXT NOT NULL REFERENCES webhook_endpoints (id) ON DELETE CASCADE,
    -- Kept when the job is deleted.
    job           TEXT NOT NULL,
    event         TEXT NOT NULL,
    body          TEXT NOT NULL,
    state         TEXT NOT NULL CHECK (state IN ('pending', 'delivered', 'failed')),
    -- All that were ever begun. It fences: an outcome must name the attempt that it is of.
    attempts      INTEGER NOT NULL DEFAULT 0,
    -- Those since the delivery was made or last asked for again; its place in the schedule.
    tries         INTEGER NOT NULL DEFAULT 0,
    due_at        INTEGER,
    lease_until   INTEGER,
    created_at    INTEGER NOT NULL,
    attempted_at  INTEGER,
    delivered_at  INTEGER,
    -- What the latest attempt came to.
    answer_status INTEGER,
    answer_fault  TEXT,
    CHECK ((state = 'pending') = (due_at IS NOT NULL)),
    CHECK (state = 'pending' OR lease_until IS NULL),
    CHECK ((state = 'delivered') = (delivered_at IS NOT NULL))
) STRICT;
INSERT INTO webhook_deliveries VALUES(1,'01890a5d-ac96-774b-bcce-b30200000006','01890a5d-ac96-774b-bcce-b30200000005','01890a5d-ac96-774b-bcce-b302099a8057','job.succeeded','{}','delivered',1,1,NULL,NULL,7,7,7,204,NULL);
CREATE TABLE webhook_endpoints (
    id          TEXT PRIMARY KEY,
    owner       TEXT REFERENCES keys (id),
    url         TEXT NOT NULL,
    -- Names of the events that it wants, as a JSON array.
    events      TEXT NOT NULL,
    description TEXT,
    -- What signs is needed in clear at every delivery, so it cannot be hashed as keys are.
    secret      TEXT NOT NULL,
    created_at  INTEGER NOT NULL,
    -- When it answered that it is gone.
    disabled_at INTEGER
) STRICT;
INSERT INTO webhook_endpoints VALUES('01890a5d-ac96-774b-bcce-b30200000005',NULL,'https://example.com/hook','["job.succeeded"]',NULL,'whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw',5,NULL);
CREATE TABLE owner_totals (
    owner          TEXT PRIMARY KEY,
    -- Jobs that are queued or running.
    active_jobs    INTEGER NOT NULL DEFAULT 0,
    -- Bytes of the blobs in owner_blobs.
    stored_bytes   INTEGER NOT NULL DEFAULT 0,
    -- Bytes promised to uploads that have not ended.
    reserved_bytes INTEGER NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;
INSERT INTO owner_totals VALUES('',0,1167,0);
INSERT INTO owner_totals VALUES('01890a5d-ac96-774b-bcce-b30200000001',1,1000,100);
CREATE TABLE owner_blobs (
    owner  TEXT NOT NULL,
    digest TEXT NOT NULL,
    uses   INTEGER NOT NULL,
    PRIMARY KEY (owner, digest)
) STRICT, WITHOUT ROWID;
INSERT INTO owner_blobs VALUES('','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa',1);
INSERT INTO owner_blobs VALUES('','bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb',1);
INSERT INTO owner_blobs VALUES('','eeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeee',1);
INSERT INTO owner_blobs VALUES('01890a5d-ac96-774b-bcce-b30200000001','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa',2);
CREATE TABLE totals (
    name  TEXT NOT NULL,
    label TEXT NOT NULL DEFAULT '',
    value INTEGER NOT NULL,
    PRIMARY KEY (name, label)
) STRICT, WITHOUT ROWID;
INSERT INTO totals VALUES('blob_bytes','',1167);
INSERT INTO totals VALUES('blobs','',3);
INSERT INTO totals VALUES('deliveries','delivered',1);
INSERT INTO totals VALUES('deliveries','failed',0);
INSERT INTO totals VALUES('deliveries','pending',0);
INSERT INTO totals VALUES('jobs','cancelled',0);
INSERT INTO totals VALUES('jobs','failed',0);
INSERT INTO totals VALUES('jobs','queued',1);
INSERT INTO totals VALUES('jobs','running',0);
INSERT INTO totals VALUES('jobs','succeeded',1);
CREATE TABLE counters (
    name  TEXT NOT NULL,
    label TEXT NOT NULL DEFAULT '',
    cause TEXT NOT NULL DEFAULT '',
    value REAL NOT NULL,
    PRIMARY KEY (name, label, cause)
) STRICT, WITHOUT ROWID;
INSERT INTO counters VALUES('attempts_ended','succeeded','',1.0);
INSERT INTO counters VALUES('claims','','',1.0);
INSERT INTO counters VALUES('phase_seconds','decode','',0.10000000000000000555);
INSERT INTO counters VALUES('phase_seconds','encode','',0.5);
INSERT INTO counters VALUES('phase_seconds','ingest','',1.0);
INSERT INTO counters VALUES('phase_seconds','train','',60.0);
DELETE FROM sqlite_sequence;
INSERT INTO sqlite_sequence VALUES('webhook_deliveries',1);
CREATE INDEX jobs_to_claim ON jobs (priority DESC, created_at, id) WHERE state = 'queued';
CREATE INDEX jobs_by_lease ON jobs (lease_until) WHERE state = 'running';
CREATE INDEX jobs_by_age ON jobs (created_at, id);
CREATE INDEX scenes_by_age ON scenes (created_at, id);
CREATE INDEX scenes_by_dataset ON scenes (dataset);
CREATE INDEX jobs_by_owner ON jobs (owner, created_at, id);
CREATE INDEX jobs_by_scene ON jobs (scene) WHERE scene IS NOT NULL;
CREATE INDEX jobs_by_dataset ON jobs (dataset);
CREATE INDEX jobs_by_deadline ON jobs (deadline_at) WHERE deadline_at IS NOT NULL AND state IN ('queued', 'running');
CREATE UNIQUE INDEX scenes_of_an_owner ON scenes (IFNULL(owner, ''), dataset);
CREATE INDEX uploads_open ON uploads (expires_at) WHERE ended_at IS NULL;
CREATE INDEX uploads_ended ON uploads (ended_at) WHERE ended_at IS NOT NULL;
CREATE INDEX uploads_by_owner ON uploads (owner);
CREATE INDEX uploads_by_scene ON uploads (scene) WHERE scene IS NOT NULL;
CREATE INDEX idempotency_by_age ON idempotency (created_at);
CREATE INDEX exports_by_digest ON exports (digest);
CREATE INDEX exports_by_source ON exports (source);
CREATE INDEX webhook_endpoints_by_owner ON webhook_endpoints (owner);
CREATE INDEX webhook_deliveries_due ON webhook_deliveries (due_at, seq) WHERE state = 'pending';
CREATE INDEX webhook_deliveries_under_way ON webhook_deliveries (endpoint) WHERE lease_until IS NOT NULL;
CREATE INDEX webhook_deliveries_by_endpoint ON webhook_deliveries (endpoint, seq);
CREATE INDEX webhook_deliveries_by_age ON webhook_deliveries (created_at) WHERE state <> 'pending';
CREATE INDEX artifacts_by_digest ON artifacts (digest);
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
COMMIT;
