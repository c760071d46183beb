//! The worker: its loop, its supervision, and what it does when the disk is full.

mod full_disk;
mod supervision;
