-- How alike pictures of an export and of the scene that it was made of are; both or neither is known.
ALTER TABLE exports ADD COLUMN likeness_psnr REAL;
ALTER TABLE exports ADD COLUMN likeness_views INTEGER
    CHECK (likeness_views > 0 AND (likeness_psnr IS NULL) = (likeness_views IS NULL));
