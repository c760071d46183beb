//! All integration tests in one binary: one link, one GPU context per process.

mod layers;
mod primitives;
mod raster_device;
mod raster_oracles;
mod raster_twin;
mod support;
