//! The GPU layer: scan, sort, tests for finite numbers, limits of a device and recovery from its loss.

mod finite;
mod primitives;
