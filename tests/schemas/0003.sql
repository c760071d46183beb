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
    finished_at         INTEGER,
    CHECK ((state = 'running') = (lease_owner IS NOT NULL)),
    CHECK ((state = 'running') = (lease_until IS NOT NULL)),
    CHECK ((state IN ('succeeded', 'failed', 'cancelled')) = (finished_at IS NOT NULL))
) STRICT;
INSERT INTO "jobs" VALUES('01890a5d-ac96-774b-bcce-b302099a8057','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','succeeded','done','{}','{"test":{"psnr":30.5,"ssim":0.97,"lpips":null,"views":3},"train":{"psnr":31.0,"ssim":0.98,"lpips":null,"views":9},"bytes":{"total":77,"positions":1,"networks":2,"planes":0,"masks":3,"features":4,"scalings":5,"offsets":6,"container":56},"seconds":{"ingest":1.0,"train":60.0,"encode":0.5,"decode":0.1},"steps":400,"steps_per_second":6.5,"anchors":10,"gaussians":20,"psnr_before_quantisation":30.6,"adapter":"llvmpipe","background":"black","decode_sha256":"cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc"}',NULL,0,5,1,1,3,0,NULL,NULL,NULL,NULL,1,1,5,6,7);
INSERT INTO "jobs" VALUES('01890a5d-ac96-774b-bcce-b30200000003','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','{}','queued','queued','{}',NULL,NULL,0,5,0,0,3,0,NULL,NULL,NULL,NULL,1,1,8,NULL,NULL);
CREATE INDEX jobs_to_claim ON jobs (priority DESC, created_at, id) WHERE state = 'queued';
CREATE INDEX jobs_by_lease ON jobs (lease_until) WHERE state = 'running';
CREATE INDEX jobs_by_age ON jobs (created_at, id);
COMMIT;
