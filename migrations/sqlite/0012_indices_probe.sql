-- Lists of one owner, the oldest job that waits, and what a deletion looks for are found without reading whole tables.

CREATE INDEX scenes_by_owner ON scenes (owner, created_at, id);
CREATE INDEX jobs_by_owner_state ON jobs (owner, state, created_at, id);
CREATE INDEX jobs_queued_by_age ON jobs (created_at) WHERE state = 'queued';
CREATE INDEX jobs_active_by_scene ON jobs (scene) WHERE state IN ('queued', 'running');
CREATE INDEX jobs_by_retry ON jobs (retry_of) WHERE retry_of IS NOT NULL;
DROP INDEX jobs_by_scene;
CREATE INDEX jobs_by_scene ON jobs (scene, created_at, id) WHERE scene IS NOT NULL;

-- What is written to find out whether anything can be: one row, which says when that was last done.
CREATE TABLE write_probe (
    id INTEGER PRIMARY KEY CHECK (id = 1),
    at INTEGER NOT NULL
) STRICT;
