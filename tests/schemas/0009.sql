BEGIN TRANSACTION;
CREATE TABLE _sqlx_migrations (
    version BIGINT PRIMARY KEY,
    description TEXT NOT NULL,
    installed_on TIMESTAMP NOT NULL DEFAULT CURRENT_TIMESTAMP,
    success BOOLEAN NOT NULL,
    checksum BLOB NOT NULL,
    execution_time BIGINT NOT NULL
);
INSERT INTO "_sqlx_migrations" VALUES(1,'queue','2026-11-22 00:00:00',1,X'60E652C7DDC7596BD55C2BB65DC6C1613A536CAC773A1959FAC183BFB3C3969D82E9D4502167C5E41CB48F1B6BEC9F23',1000);
INSERT INTO "_sqlx_migrations" VALUES(2,'artifact kinds','2026-11-22 00:00:00',1,X'3F5F8814D83C7880EE8D84F166D6BECEC54A8116E4FB29E181F17D8975EC4287E94B9E9602D2DE281F0ED9F1CFAB23E5',1000);
INSERT INTO "_sqlx_migrations" VALUES(3,'curve artifacts','2026-11-22 00:00:00',1,X'E9C00975DF3A32F1ADC1E29CE24719B0F869EE53217BEC43C429B4E2428185BC57EC586214A5C983C1AE795FEFF98818',1000);
INSERT INTO "_sqlx_migrations" VALUES(4,'owners and scenes','2026-11-22 00:00:00',1,X'84F5349AC4FEBC170184F3B1B06B3768D2DAC804C5F4C771606EE9DF3503C32B6187444A757BE96A654CEA6B5E3B3D7C',1000);
INSERT INTO "_sqlx_migrations" VALUES(5,'uploads','2026-11-22 00:00:00',1,X'7A0A1DE5F54B195FE2C4596F700B62338BA3B8F9AD39ECA4A11F8B6379CEDD9D61C863EF394954F709B274750636A00F',1000);
INSERT INTO "_sqlx_migrations" VALUES(6,'idempotency exports','2026-11-22 00:00:00',1,X'16103169BE6BDC1733F342F8DE90636C1CFAE8E9F74B776C19300D73EA391F3EA70B8F9A14878E171FE0C73B97A21C8D',1000);
INSERT INTO "_sqlx_migrations" VALUES(7,'series webhooks','2026-11-22 00:00:00',1,X'E89CAB99F5074576A03004BABCE6555EB46567DB49A11EFD7599D2341F2C8DC1D7125A97D80DD5BD4C5CAD429CBD7F79',1000);
INSERT INTO "_sqlx_migrations" VALUES(9,'held out views','2026-11-22 00:00:00',1,X'399FDE53492E205F23D37FB40236BA92E168AABF6A8B9EBDEA3D50B23D299E91DD7B27D7BF79C2A404CB644160005C43',1000);
CREATE TABLE "artifacts" (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out')),
    -- The place in the order in which they were published; 0 is the one that is meant where none is named.
    place   INTEGER NOT NULL CHECK (place >= 0),
    lambda  REAL,
    digest  TEXT NOT NULL REFERENCES blobs (digest),
    attempt INTEGER NOT NULL,
    PRIMARY KEY (job_id, kind, place)
) STRICT, WITHOUT ROWID;
INSERT INTO "artifacts" VALUES('01890a5d-ac96-774b-bcce-b302099a8057','tcgs',0,NULL,'bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb',1);
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
INSERT INTO "attempts" VALUES('01890a5d-ac96-774b-bcce-b302099a8057',1,'a worker',6,7,'succeeded',NULL);
CREATE TABLE blobs (
    digest     TEXT PRIMARY KEY,
    bytes      INTEGER NOT NULL CHECK (bytes >= 0),
    created_at INTEGER NOT NULL
) STRICT;
INSERT INTO "blobs" VALUES('aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa',1000,5);
INSERT INTO "blobs" VALUES('bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb',77,5);
INSERT INTO "blobs" VALUES('eeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeee',90,5);
CREATE TABLE events (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    seq     INTEGER NOT NULL CHECK (seq > 0),
    at      INTEGER NOT NULL,
    kind    TEXT NOT NULL,
    attempt INTEGER NOT NULL,
    data    TEXT NOT NULL,
    PRIMARY KEY (job_id, seq)
) STRICT, WITHOUT ROWID;
INSERT INTO "events" VALUES('01890a5d-ac96-774b-bcce-b30200000003',1,5,'state',0,'{"state":"queued"}');
INSERT INTO "events" VALUES('01890a5d-ac96-774b-bcce-b302099a8057',1,5,'state',0,'{"state":"queued"}');
CREATE TABLE exports (
    job_id     TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    -- The artifact that it was made of.
    source     TEXT NOT NULL REFERENCES blobs (digest),
    format     TEXT NOT NULL CHECK (format IN ('ply', 'spz')),
    digest     TEXT NOT NULL REFERENCES blobs (digest),
    gaussians  INTEGER NOT NULL CHECK (gaussians >= 0),
    sh_degree  INTEGER NOT NULL CHECK (sh_degree BETWEEN 0 AND 3),
    created_at INTEGER NOT NULL,
    PRIMARY KEY (job_id, source, format)
) STRICT, WITHOUT ROWID;
INSERT INTO "exports" VALUES('01890a5d-ac96-774b-bcce-b302099a8057','bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb','ply','eeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeeee',20,3,8);
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
INSERT INTO "idempotency" VALUES('01890a5d-ac96-774b-bcce-b30200000001','a request','ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff',201,'01890a5d-ac96-774b-bcce-b30200000003',5);
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
INSERT INTO "jobs" VALUES('01890a5d-ac96-774b-bcce-b302099a8057','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','succeeded','done','{}','{"test":{"psnr":30.5,"ssim":0.97,"lpips":null,"views":3},"train":{"psnr":31.0,"ssim":0.98,"lpips":null,"views":9},"bytes":{"total":77,"positions":1,"networks":2,"planes":0,"masks":3,"features":4,"scalings":5,"offsets":6,"container":56},"seconds":{"ingest":1.0,"train":60.0,"encode":0.5,"decode":0.1},"steps":400,"steps_per_second":6.5,"anchors":10,"gaussians":20,"psnr_before_quantisation":30.6,"adapter":"llvmpipe","background":"black","decode_sha256":"cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc"}',NULL,0,5,1,1,3,0,NULL,NULL,NULL,NULL,1,1,5,6,7,NULL,NULL,NULL,NULL,0);
INSERT INTO "jobs" VALUES('01890a5d-ac96-774b-bcce-b30200000003','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','queued','queued','{}',NULL,NULL,0,5,0,0,3,0,NULL,NULL,NULL,NULL,1,1,8,NULL,NULL,'01890a5d-ac96-774b-bcce-b30200000001','01890a5d-ac96-774b-bcce-b30200000002',NULL,NULL,0);
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
INSERT INTO "keys" VALUES('01890a5d-ac96-774b-bcce-b30200000001','a key','tcgs_0123','dddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddd','read jobs:write',NULL,NULL,NULL,5,NULL,NULL);
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
INSERT INTO "scenes" VALUES('01890a5d-ac96-774b-bcce-b30200000002','01890a5d-ac96-774b-bcce-b30200000001','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','a scene','{"layout":"blender","train":9,"test":3,"pixels":12000,"points":null,"notes":[]}',1,5);
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
INSERT INTO "series" VALUES('01890a5d-ac96-774b-bcce-b302099a8057',999,1,400,60.0,0.01,31.0,10,20,80);
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
INSERT INTO "uploads" VALUES('01890a5d-ac96-774b-bcce-b30200000004','01890a5d-ac96-774b-bcce-b30200000001',100,40,NULL,NULL,5,9000000000000000,NULL);
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
INSERT INTO "webhook_deliveries" VALUES(1,'01890a5d-ac96-774b-bcce-b30200000006','01890a5d-ac96-774b-bcce-b30200000005','01890a5d-ac96-774b-bcce-b302099a8057','job.succeeded','{}','delivered',1,1,NULL,NULL,7,7,7,204,NULL);
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
INSERT INTO "webhook_endpoints" VALUES('01890a5d-ac96-774b-bcce-b30200000005',NULL,'https://example.com/hook','["job.succeeded"]',NULL,'whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw',5,NULL);
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
DELETE FROM "sqlite_sequence";
INSERT INTO "sqlite_sequence" VALUES('webhook_deliveries',1);
COMMIT;
