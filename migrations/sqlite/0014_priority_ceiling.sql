-- The highest priority that a key may give its jobs; the service's default if absent.
ALTER TABLE keys ADD COLUMN max_priority INTEGER CHECK (max_priority BETWEEN -100 AND 100);
