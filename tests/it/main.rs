//! All integration tests in one binary: one link, one GPU context per process.

mod http;
mod layers;
mod queue;
mod support;
mod worker;
