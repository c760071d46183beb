//! All integration tests in one binary: one link, one GPU context per process.

mod adam;
mod checkpoint;
mod cli;
mod codec;
mod container_image;
mod first_light;
mod http;
mod ingest;
mod layers;
mod loss;
mod lpips;
mod memory;
mod neural;
mod plain;
mod primitives;
mod queue;
mod raster_device;
mod raster_oracles;
mod raster_twin;
mod sample;
mod scene_renderer;
mod support;
mod train;
mod wavelet;
mod worker;
