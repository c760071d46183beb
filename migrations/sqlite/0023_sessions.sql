-- Sessions of browsers. Each stands for a key, and ends with it.
CREATE TABLE sessions (
    -- SHA-256 of what the browser has.
    hash       TEXT NOT NULL PRIMARY KEY,
    key_id     TEXT NOT NULL REFERENCES keys (id) ON DELETE CASCADE,
    created_at INTEGER NOT NULL,
    expires_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX sessions_by_key_age ON sessions (key_id, created_at);
CREATE INDEX sessions_by_expiry ON sessions (expires_at);
