//! All integration tests in one binary: one link, one GPU context per process.

mod layers;
mod sample;
