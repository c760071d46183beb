-- Keys tell callers apart, and what a caller makes is its own. Rows without an owner were made while there were no keys.

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

-- A dataset that jobs can be made of. Its archive is a blob, stored once however often it is sent.
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

CREATE INDEX scenes_by_age ON scenes (created_at, id);
CREATE INDEX scenes_by_dataset ON scenes (dataset);

ALTER TABLE jobs ADD COLUMN owner TEXT REFERENCES keys (id);
-- The scene that it was made of, if it was not sent with its own archive.
ALTER TABLE jobs ADD COLUMN scene TEXT REFERENCES scenes (id) ON DELETE SET NULL;
-- When it is to be given up, finished or not.
ALTER TABLE jobs ADD COLUMN deadline_at INTEGER;
-- The job that it repeats.
ALTER TABLE jobs ADD COLUMN retry_of TEXT REFERENCES jobs (id) ON DELETE SET NULL;

CREATE INDEX jobs_by_owner ON jobs (owner, created_at, id);
CREATE INDEX jobs_by_scene ON jobs (scene) WHERE scene IS NOT NULL;
CREATE INDEX jobs_by_dataset ON jobs (dataset);
CREATE INDEX jobs_by_deadline ON jobs (deadline_at) WHERE deadline_at IS NOT NULL AND state IN ('queued', 'running');
CREATE INDEX artifacts_by_digest ON artifacts (digest);
