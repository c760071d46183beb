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
CREATE TABLE "artifacts" (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras')),
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
    finished_at         INTEGER, owner TEXT REFERENCES keys (id), scene TEXT REFERENCES scenes (id) ON DELETE SET NULL, deadline_at INTEGER, retry_of TEXT REFERENCES jobs (id) ON DELETE SET NULL,
    CHECK ((state = 'running') = (lease_owner IS NOT NULL)),
    CHECK ((state = 'running') = (lease_until IS NOT NULL)),
    CHECK ((state IN ('succeeded', 'failed', 'cancelled')) = (finished_at IS NOT NULL))
) STRICT;
INSERT INTO "jobs" VALUES('01890a5d-ac96-774b-bcce-b302099a8057','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','succeeded','done','{}','{"test":{"psnr":30.5,"ssim":0.97,"lpips":null,"views":3},"train":{"psnr":31.0,"ssim":0.98,"lpips":null,"views":9},"bytes":{"total":77,"positions":1,"networks":2,"planes":0,"masks":3,"features":4,"scalings":5,"offsets":6,"container":56},"seconds":{"ingest":1.0,"train":60.0,"encode":0.5,"decode":0.1},"steps":400,"steps_per_second":6.5,"anchors":10,"gaussians":20,"psnr_before_quantisation":30.6,"adapter":"llvmpipe","background":"black","decode_sha256":"cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc"}',NULL,0,5,1,1,3,0,NULL,NULL,NULL,NULL,1,1,5,6,7,NULL,NULL,NULL,NULL);
INSERT INTO "jobs" VALUES('01890a5d-ac96-774b-bcce-b30200000003','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','queued','queued','{}',NULL,NULL,0,5,0,0,3,0,NULL,NULL,NULL,NULL,1,1,8,NULL,NULL,'01890a5d-ac96-774b-bcce-b30200000001','01890a5d-ac96-774b-bcce-b30200000002',NULL,NULL);
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
CREATE INDEX jobs_to_claim ON jobs (priority DESC, created_at, id) WHERE state = 'queued';
CREATE INDEX jobs_by_lease ON jobs (lease_until) WHERE state = 'running';
CREATE INDEX jobs_by_age ON jobs (created_at, id);
CREATE INDEX scenes_by_age ON scenes (created_at, id);
CREATE INDEX scenes_by_dataset ON scenes (dataset);
CREATE INDEX jobs_by_owner ON jobs (owner, created_at, id);
CREATE INDEX jobs_by_scene ON jobs (scene) WHERE scene IS NOT NULL;
CREATE INDEX jobs_by_dataset ON jobs (dataset);
CREATE INDEX jobs_by_deadline ON jobs (deadline_at) WHERE deadline_at IS NOT NULL AND state IN ('queued', 'running');
CREATE INDEX artifacts_by_digest ON artifacts (digest);
COMMIT;
