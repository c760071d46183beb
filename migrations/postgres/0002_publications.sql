-- As version 18 of SQLite's schema.
CREATE TABLE publications (
    id             BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    digest         TEXT COLLATE "C" NOT NULL UNIQUE,
    bytes          BIGINT NOT NULL CHECK (bytes >= 0),
    published_at   BIGINT NOT NULL,
    removing_since BIGINT
);

CREATE INDEX publications_removing ON publications (removing_since) WHERE removing_since IS NOT NULL;

CREATE TABLE blob_place (
    id    TEXT COLLATE "C" NOT NULL PRIMARY KEY,
    place TEXT COLLATE "C" CHECK (place IN ('folder', 'bucket'))
);

INSERT INTO blob_place (id, place)
SELECT replace(CAST(gen_random_uuid() AS text), '-', ''), CASE WHEN EXISTS (SELECT 1 FROM blobs) THEN 'folder' END;

ALTER TABLE uploads ADD COLUMN writer BIGINT NOT NULL DEFAULT 0;
ALTER TABLE uploads ADD COLUMN writer_until BIGINT;

CREATE TABLE upload_parts (
    upload TEXT COLLATE "C" NOT NULL REFERENCES uploads (id) ON DELETE CASCADE,
    start  BIGINT NOT NULL,
    name   TEXT COLLATE "C" NOT NULL,
    PRIMARY KEY (upload, start)
);
