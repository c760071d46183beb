-- As version 20 of SQLite's schema.
ALTER TABLE jobs ADD COLUMN needs BIGINT NOT NULL DEFAULT 0 CHECK (needs BETWEEN 0 AND 2);
ALTER TABLE jobs ADD COLUMN photographs TEXT COLLATE "C";

CREATE INDEX jobs_by_photographs ON jobs (project, photographs, created_at) WHERE photographs IS NOT NULL;

CREATE FUNCTION jobs_dataset_changed() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM use_blob(NEW.project, NEW.dataset, 'dataset');
    PERFORM release_blob(OLD.project, OLD.dataset);
    RETURN NULL;
END $$;
CREATE TRIGGER jobs_dataset_changed AFTER UPDATE OF dataset ON jobs
    FOR EACH ROW WHEN (OLD.dataset <> NEW.dataset) EXECUTE FUNCTION jobs_dataset_changed();

CREATE TABLE workers (
    id      TEXT COLLATE "C" NOT NULL PRIMARY KEY,
    can     BIGINT NOT NULL CHECK (can BETWEEN 0 AND 2),
    seen_at BIGINT NOT NULL
);

ALTER TABLE artifacts DROP CONSTRAINT artifacts_kind_check;
ALTER TABLE artifacts ADD CONSTRAINT artifacts_kind_check
    CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out', 'sparse_model'));
