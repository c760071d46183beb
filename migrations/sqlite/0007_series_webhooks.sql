-- How a job's training went: at most one point for each thousandth of it, the latest there.
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

-- Where an owner wants to be told of its jobs.
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

CREATE INDEX webhook_endpoints_by_owner ON webhook_endpoints (owner);

-- The outbox: a row is written in the transaction of the change that it tells of.
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

CREATE INDEX webhook_deliveries_due ON webhook_deliveries (due_at, seq) WHERE state = 'pending';
CREATE INDEX webhook_deliveries_under_way ON webhook_deliveries (endpoint) WHERE lease_until IS NOT NULL;
CREATE INDEX webhook_deliveries_by_endpoint ON webhook_deliveries (endpoint, seq);
CREATE INDEX webhook_deliveries_by_age ON webhook_deliveries (created_at) WHERE state <> 'pending';
