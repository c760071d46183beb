-- Processes that render views and exports for API replicas.
CREATE TABLE viewers (
    -- Where replicas reach it.
    url      TEXT NOT NULL PRIMARY KEY,
    version  TEXT NOT NULL,
    -- What determines the bits of its pictures beside scene and camera.
    identity TEXT NOT NULL,
    -- What it expects of replicas.
    token    TEXT NOT NULL,
    -- When it last said that it is alive.
    seen_at  INTEGER NOT NULL
) STRICT;
