//! Rendering: kernels of rows, networks and tiles against their f64 twins, central differences and independent values.

mod neural;
mod plain;
mod raster_device;
mod raster_oracles;
mod raster_twin;
mod scene_renderer;
