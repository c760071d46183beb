-- Exports in two versions of .spz: 'spz' is version 4 from now on. What was kept as 'spz' so far is of version 3.
CREATE TABLE exports_new (
    job_id     TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    -- The artifact that it was made of.
    source     TEXT NOT NULL REFERENCES blobs (digest),
    format     TEXT NOT NULL CHECK (format IN ('ply', 'spz', 'spz3')),
    digest     TEXT NOT NULL REFERENCES blobs (digest),
    gaussians  INTEGER NOT NULL CHECK (gaussians >= 0),
    sh_degree  INTEGER NOT NULL CHECK (sh_degree BETWEEN 0 AND 3),
    created_at INTEGER NOT NULL,
    -- How alike pictures of the export and of the scene are; both or neither is known.
    likeness_psnr  REAL,
    likeness_views INTEGER CHECK (likeness_views > 0 AND (likeness_psnr IS NULL) = (likeness_views IS NULL)),
    PRIMARY KEY (job_id, source, format)
) STRICT, WITHOUT ROWID;

INSERT INTO exports_new (job_id, source, format, digest, gaussians, sh_degree, created_at, likeness_psnr, likeness_views)
    SELECT job_id, source, CASE format WHEN 'spz' THEN 'spz3' ELSE format END, digest, gaussians, sh_degree, created_at,
        likeness_psnr, likeness_views
    FROM exports;

DROP TABLE exports;
ALTER TABLE exports_new RENAME TO exports;

CREATE INDEX exports_by_digest ON exports (digest);
CREATE INDEX exports_by_source ON exports (source);
