-- As version 19 of SQLite's schema.
CREATE TABLE viewers (
    url      TEXT COLLATE "C" NOT NULL PRIMARY KEY,
    version  TEXT COLLATE "C" NOT NULL,
    identity TEXT COLLATE "C" NOT NULL,
    token    TEXT COLLATE "C" NOT NULL,
    seen_at  BIGINT NOT NULL
);
