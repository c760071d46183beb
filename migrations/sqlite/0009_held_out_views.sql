-- A finished job keeps pictures of held-out views for its report. SQLite cannot change a check, so the table is made anew.

CREATE TABLE artifacts_with_held_out (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out')),
    -- The place in the order in which they were published; 0 is the one that is meant where none is named.
    place   INTEGER NOT NULL CHECK (place >= 0),
    lambda  REAL,
    digest  TEXT NOT NULL REFERENCES blobs (digest),
    attempt INTEGER NOT NULL,
    PRIMARY KEY (job_id, kind, place)
) STRICT, WITHOUT ROWID;

INSERT INTO artifacts_with_held_out (job_id, kind, place, lambda, digest, attempt)
SELECT job_id, kind, place, lambda, digest, attempt FROM artifacts;

DROP TABLE artifacts;

ALTER TABLE artifacts_with_held_out RENAME TO artifacts;

CREATE INDEX artifacts_by_digest ON artifacts (digest);
