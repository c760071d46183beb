-- As version 22 of SQLite's schema.
ALTER TABLE artifacts DROP CONSTRAINT artifacts_kind_check;
ALTER TABLE artifacts ADD CONSTRAINT artifacts_kind_check
    CHECK (kind IN ('tcgs', 'safetensors', 'ply', 'cameras', 'held_out', 'sparse_model', 'thumbnail', 'preview',
        'preview_photograph'));
