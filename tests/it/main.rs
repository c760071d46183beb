//! All integration tests in one binary: one link, one GPU context per process.

mod ingest;
mod layers;
mod support;
