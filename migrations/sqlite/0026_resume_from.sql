-- The job whose checkpoint a retry may resume from; it is known also once that job is deleted, or never ran and was to resume from another.
ALTER TABLE jobs ADD COLUMN resume_from TEXT;
UPDATE jobs SET resume_from = retry_of WHERE from_checkpoint;
ALTER TABLE jobs DROP COLUMN from_checkpoint;
CREATE INDEX jobs_by_resumption ON jobs (resume_from) WHERE resume_from IS NOT NULL;
