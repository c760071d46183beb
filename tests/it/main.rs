//! All integration tests in one binary: one link, one GPU context per process.

mod codec;
mod http;
mod layers;
mod primitives;
mod queue;
mod raster_oracles;
mod support;
mod worker;
