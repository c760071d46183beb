-- Cameras of photographs that have none are found before training.

-- What a worker must be able to do before it trains: 0 nothing, 1 find cameras, 2 also take photographs from a video.
ALTER TABLE jobs ADD COLUMN needs INTEGER NOT NULL DEFAULT 0 CHECK (needs BETWEEN 0 AND 2);

-- The photographs or the video that the dataset was made of, once its cameras are found.
ALTER TABLE jobs ADD COLUMN photographs TEXT;

CREATE INDEX jobs_by_photographs ON jobs (project, photographs, created_at) WHERE photographs IS NOT NULL;

CREATE TRIGGER jobs_dataset_changed AFTER UPDATE OF dataset ON jobs WHEN OLD.dataset <> NEW.dataset BEGIN
    INSERT INTO project_blobs (project, digest, uses, kind) VALUES (NEW.project, NEW.dataset, 1, 'dataset')
    ON CONFLICT (project, digest) DO UPDATE SET uses = uses + 1;
    UPDATE project_blobs SET uses = uses - 1 WHERE project = OLD.project AND digest = OLD.dataset;
END;

-- Workers, and what they can do, as in jobs.needs.
CREATE TABLE workers (
    id      TEXT NOT NULL PRIMARY KEY,
    can     INTEGER NOT NULL CHECK (can BETWEEN 0 AND 2),
    -- When it last said that it is alive.
    seen_at INTEGER NOT NULL
) STRICT;

-- A finished job keeps the model of its cameras. SQLite cannot change a check, so the table is made anew.
CREATE TABLE artifacts_with_models (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out', 'sparse_model')),
    -- The place in the order in which they were published; 0 is the one that is meant where none is named.
    place   INTEGER NOT NULL CHECK (place >= 0),
    lambda  REAL,
    digest  TEXT NOT NULL REFERENCES blobs (digest),
    attempt INTEGER NOT NULL,
    PRIMARY KEY (job_id, kind, place)
) STRICT, WITHOUT ROWID;

INSERT INTO artifacts_with_models (job_id, kind, place, lambda, digest, attempt)
SELECT job_id, kind, place, lambda, digest, attempt FROM artifacts;

-- A trigger that names a table which is gone for a moment stops its renaming.
DROP TRIGGER jobs_removing;
DROP TABLE artifacts;

ALTER TABLE artifacts_with_models RENAME TO artifacts;

CREATE INDEX artifacts_by_digest ON artifacts (digest);

CREATE TRIGGER artifacts_added AFTER INSERT ON artifacts BEGIN
    INSERT INTO project_blobs (project, digest, uses, kind)
    SELECT project, NEW.digest, 1, 'artifact' FROM jobs WHERE id = NEW.job_id
    ON CONFLICT (project, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER artifacts_removed AFTER DELETE ON artifacts BEGIN
    UPDATE project_blobs SET uses = uses - 1
    WHERE digest = OLD.digest AND project = (SELECT project FROM jobs WHERE id = OLD.job_id);
END;
CREATE TRIGGER jobs_removing BEFORE DELETE ON jobs BEGIN
    DELETE FROM artifacts WHERE job_id = OLD.id;
    DELETE FROM exports WHERE job_id = OLD.id;
END;
