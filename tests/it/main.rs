//! All integration tests in one binary: one link, one GPU context per process.

mod codec;
mod layers;
mod primitives;
mod raster_oracles;
mod support;
