//! `tcgs` trains anchor-based Gaussian-splatting scenes from posed photographs on any wgpu adapter,
//! compresses them with the TC-GS method into one self-contained file, and serves the result over HTTP.
//!
//! To read such files in another program, depend on the crate `tcgs-codec` alone. Here it is the module [`codec`], and [`domain`] has its
//! types beside those of the service.
//!
//! The modules below are the layers, lowest first; a module may use only the layers named in
//! `tests/it/layers.rs`, which reads every `use crate::` line and holds that table.

pub mod accuracy;
pub mod domain;
pub mod eval;
pub mod export;
pub mod gpu;
pub mod http;
pub mod https;
pub mod ingest;
pub mod model;
pub mod picture;
pub mod pipeline;
pub mod plot;
pub mod ply;
pub mod render;
pub mod sample;
pub mod store;
pub mod train;
pub mod viewers;
pub mod webhooks;
pub mod worker;

pub use tcgs_codec as codec;
