-- As version 25 of SQLite's schema.
ALTER TABLE exports DROP CONSTRAINT exports_format_check;
ALTER TABLE exports ADD CONSTRAINT exports_format_check
    CHECK (format IN ('ply', 'spz', 'spz3', 'glb', 'usda', 'sog'));
