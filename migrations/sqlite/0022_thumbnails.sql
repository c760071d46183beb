-- A finished job keeps a small picture, and one in training has a picture of what it is. SQLite cannot change a check, so the table is made anew.
CREATE TABLE artifacts_with_thumbnails (
    job_id  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind    TEXT NOT NULL CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out', 'sparse_model', 'thumbnail', 'preview',
        'preview_photograph')),
    -- The place in the order in which they were published; 0 is the one that is meant where none is named.
    place   INTEGER NOT NULL CHECK (place >= 0),
    lambda  REAL,
    digest  TEXT NOT NULL REFERENCES blobs (digest),
    attempt INTEGER NOT NULL,
    PRIMARY KEY (job_id, kind, place)
) STRICT, WITHOUT ROWID;

INSERT INTO artifacts_with_thumbnails (job_id, kind, place, lambda, digest, attempt)
SELECT job_id, kind, place, lambda, digest, attempt FROM artifacts;

-- A trigger that names a table which is gone for a moment stops its renaming.
DROP TRIGGER jobs_removing;
DROP TABLE artifacts;

ALTER TABLE artifacts_with_thumbnails RENAME TO artifacts;

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
