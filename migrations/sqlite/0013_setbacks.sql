-- A job is given up for ending its worker only if it got no further in between, so where its attempts had got to is kept.

-- The step of the newest checkpoint that an attempt reported.
ALTER TABLE jobs ADD COLUMN checkpoint_step INTEGER NOT NULL DEFAULT 0 CHECK (checkpoint_step >= 0);
-- What that was when the latest attempt ended.
ALTER TABLE jobs ADD COLUMN setback_step INTEGER NOT NULL DEFAULT 0 CHECK (setback_step >= 0);
-- Attempts in a row that ended without a word and without a newer checkpoint.
ALTER TABLE jobs ADD COLUMN setbacks INTEGER NOT NULL DEFAULT 0 CHECK (setbacks >= 0);
-- When a queued job began to wait until run_after. A clock that shows less has been set back since.
ALTER TABLE jobs ADD COLUMN waits_since INTEGER NOT NULL DEFAULT 0;

-- A job that was never begun waits for nothing.
UPDATE jobs SET run_after = 0 WHERE state = 'queued' AND attempt = 0;
