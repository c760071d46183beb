//! Kernels of rows, networks and tiles against their f64 twins, central differences and independent values, and rendering of scenes.
//! One binary, so one device.

mod gpu;
mod neural;
mod plain;
mod raster_device;
mod raster_oracles;
mod raster_twin;
mod renderer;
mod support;
