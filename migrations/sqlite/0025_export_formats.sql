-- Exports as .glb, .usda and .sog.
CREATE TABLE exports_new (
    job_id     TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    -- The artifact that it was made of.
    source     TEXT NOT NULL REFERENCES blobs (digest),
    format     TEXT NOT NULL CHECK (format IN ('ply', 'spz', 'spz3', 'glb', 'usda', 'sog')),
    digest     TEXT NOT NULL REFERENCES blobs (digest),
    gaussians  INTEGER NOT NULL CHECK (gaussians >= 0),
    sh_degree  INTEGER NOT NULL CHECK (sh_degree BETWEEN 0 AND 3),
    created_at INTEGER NOT NULL,
    -- How alike pictures of the export and of the scene are; both or neither is known.
    likeness_psnr  REAL,
    likeness_views INTEGER CHECK (likeness_views > 0 AND (likeness_psnr IS NULL) = (likeness_views IS NULL)),
    PRIMARY KEY (job_id, source, format)
) STRICT, WITHOUT ROWID;

INSERT INTO exports_new SELECT * FROM exports;

-- A trigger that names a table which is gone for a moment stops its renaming.
DROP TRIGGER jobs_removing;
DROP TABLE exports;
ALTER TABLE exports_new RENAME TO exports;

CREATE INDEX exports_by_digest ON exports (digest);
CREATE INDEX exports_by_source ON exports (source);

-- The triggers that went with the table, and the one above.
CREATE TRIGGER exports_added AFTER INSERT ON exports BEGIN
    INSERT INTO project_blobs (project, digest, uses, kind)
    SELECT project, NEW.digest, 1, 'export' FROM jobs WHERE id = NEW.job_id
    ON CONFLICT (project, digest) DO UPDATE SET uses = uses + 1;
END;
CREATE TRIGGER exports_removed AFTER DELETE ON exports BEGIN
    UPDATE project_blobs SET uses = uses - 1
    WHERE digest = OLD.digest AND project = (SELECT project FROM jobs WHERE id = OLD.job_id);
END;
CREATE TRIGGER jobs_removing BEFORE DELETE ON jobs BEGIN
    DELETE FROM artifacts WHERE job_id = OLD.id;
    DELETE FROM exports WHERE job_id = OLD.id;
END;
