-- An owner has a dataset once, however often it is sent.
CREATE UNIQUE INDEX scenes_of_an_owner ON scenes (IFNULL(owner, ''), dataset);

-- Archives that come in parts (tus). Their bytes are files of their own until a scene is made of them.
CREATE TABLE uploads (
    id         TEXT PRIMARY KEY,
    owner      TEXT REFERENCES keys (id),
    -- At most a pebibyte, so that no sum of lengths overflows.
    length     INTEGER NOT NULL CHECK (length BETWEEN 0 AND 1125899906842624),
    -- How many bytes are surely on disk; never more than the file holds.
    received   INTEGER NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND length),
    -- Upload-Metadata as it was sent.
    metadata   TEXT,
    -- The scene that was made of it.
    scene      TEXT REFERENCES scenes (id) ON DELETE SET NULL,
    created_at INTEGER NOT NULL,
    expires_at INTEGER NOT NULL,
    -- When it ceased to take bytes and to count against its owner's room: used or expired. The row stays for a while to say so.
    ended_at   INTEGER
) STRICT;

CREATE INDEX uploads_open ON uploads (expires_at) WHERE ended_at IS NULL;
CREATE INDEX uploads_ended ON uploads (ended_at) WHERE ended_at IS NOT NULL;
CREATE INDEX uploads_by_owner ON uploads (owner);
CREATE INDEX uploads_by_scene ON uploads (scene) WHERE scene IS NOT NULL;
