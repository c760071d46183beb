-- What a bucket has or may have: a blob is here from before its object is made until after it is deleted. Unused while blobs are files of
-- the data folder.
CREATE TABLE publications (
    -- Never used again, so that it tells a row from a later one of the same blob.
    id             INTEGER PRIMARY KEY AUTOINCREMENT,
    digest         TEXT NOT NULL UNIQUE,
    bytes          INTEGER NOT NULL CHECK (bytes >= 0),
    -- The latest publication; later than every one before.
    published_at   INTEGER NOT NULL,
    -- Since when its object is being deleted, if it is.
    removing_since INTEGER
) STRICT;

CREATE INDEX publications_removing ON publications (removing_since) WHERE removing_since IS NOT NULL;

-- The one row says which database this is, and where its blobs are once that is decided.
CREATE TABLE blob_place (
    id    TEXT NOT NULL PRIMARY KEY,
    place TEXT CHECK (place IN ('folder', 'bucket'))
) STRICT;

INSERT INTO blob_place (id, place)
SELECT lower(hex(randomblob(16))), CASE WHEN EXISTS (SELECT 1 FROM blobs) THEN 'folder' END;

-- Which writer of an upload has its lock, and until when, unless it renews it. Unused while uploads are files.
ALTER TABLE uploads ADD COLUMN writer INTEGER NOT NULL DEFAULT 0;
ALTER TABLE uploads ADD COLUMN writer_until INTEGER;

-- The parts of an upload that a bucket has, from its first byte to the last received, without gaps.
CREATE TABLE upload_parts (
    upload TEXT NOT NULL REFERENCES uploads (id) ON DELETE CASCADE,
    start  INTEGER NOT NULL,
    name   TEXT NOT NULL,
    PRIMARY KEY (upload, start)
) STRICT;
