-- As version 23 of SQLite's schema.
CREATE TABLE sessions (
    hash       TEXT COLLATE "C" NOT NULL PRIMARY KEY,
    key_id     TEXT COLLATE "C" NOT NULL REFERENCES keys (id) ON DELETE CASCADE,
    created_at BIGINT NOT NULL,
    expires_at BIGINT NOT NULL
);

CREATE INDEX sessions_by_key_age ON sessions (key_id, created_at);
CREATE INDEX sessions_by_expiry ON sessions (expires_at);
