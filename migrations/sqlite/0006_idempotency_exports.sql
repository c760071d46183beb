-- What requests with an Idempotency-Key made, written with what they made. A request that is still being answered has no row,
-- so one that a crash cut off stands in nobody's way.
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

CREATE INDEX idempotency_by_age ON idempotency (created_at);

-- Finished scenes in formats that other programs read, made when first asked for.
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

CREATE INDEX exports_by_digest ON exports (digest);
CREATE INDEX exports_by_source ON exports (source);

-- Whether a repeated job may go on from where the one that it repeats stopped.
ALTER TABLE jobs ADD COLUMN from_checkpoint INTEGER NOT NULL DEFAULT 0 CHECK (from_checkpoint IN (0, 1));
