-- A rate-distortion curve is several files of one kind, told apart by their weight of the rate. SQLite cannot change a key, so
-- the table is made anew.

CREATE TABLE artifacts_of_curves (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras')),
    -- The place in the order in which they were published; 0 is the one that is meant where none is named.
    place   INTEGER NOT NULL CHECK (place >= 0),
    lambda  REAL,
    digest  TEXT NOT NULL REFERENCES blobs (digest),
    attempt INTEGER NOT NULL,
    PRIMARY KEY (job_id, kind, place)
) STRICT, WITHOUT ROWID;

INSERT INTO artifacts_of_curves (job_id, kind, place, lambda, digest, attempt)
SELECT job_id, kind, 0, NULL, digest, attempt FROM artifacts;

DROP TABLE artifacts;

ALTER TABLE artifacts_of_curves RENAME TO artifacts;
