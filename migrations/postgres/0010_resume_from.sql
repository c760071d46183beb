-- As version 26 of SQLite's schema.
ALTER TABLE jobs ADD COLUMN resume_from TEXT COLLATE "C";
UPDATE jobs SET resume_from = retry_of WHERE from_checkpoint;
ALTER TABLE jobs DROP COLUMN from_checkpoint;
CREATE INDEX jobs_by_resumption ON jobs (resume_from) WHERE resume_from IS NOT NULL;
