//! All integration tests in one binary: one link, one GPU context per process.

mod cli;
mod codec;
mod layers;
mod sample;
