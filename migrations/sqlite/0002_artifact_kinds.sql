-- Baselines are published as safetensors and ply. SQLite cannot change a check, so the table is made anew.

CREATE TABLE artifacts_of_any_kind (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras')),
    digest  TEXT NOT NULL REFERENCES blobs (digest),
    attempt INTEGER NOT NULL,
    PRIMARY KEY (job_id, kind)
) STRICT, WITHOUT ROWID;

INSERT INTO artifacts_of_any_kind (job_id, kind, digest, attempt)
SELECT job_id, kind, digest, attempt FROM artifacts;

DROP TABLE artifacts;

ALTER TABLE artifacts_of_any_kind RENAME TO artifacts;
