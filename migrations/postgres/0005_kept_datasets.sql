-- A dataset that came as the body of a job is one too. Until it is kept by a request of its own, it is deleted with its last job.
ALTER TABLE scenes ADD COLUMN kept BOOLEAN NOT NULL DEFAULT TRUE;
