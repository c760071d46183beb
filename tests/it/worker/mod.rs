//! The worker: its loop, its supervision, and what it does when the disk is full or the bucket is away.

mod checkpoint_copies;
mod full_disk;
mod supervision;
