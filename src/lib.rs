//! `tcgs` trains anchor-based Gaussian-splatting scenes from posed photographs on any wgpu adapter,
//! compresses them with the TC-GS method into one self-contained file, and serves the result over HTTP.
//!
//! It is the service and the command line. To read such files in another program, depend on the crate `tcgs-codec`; to render them,
//! on `tcgs-render`; to train, on `tcgs-engine`. Their modules have names here too, and [`domain`] has their types beside those of the
//! service.
//!
//! The modules below are layers; a module may use only those named in `tests/it/layers.rs`, which reads every path and holds that
//! table.

pub mod domain;
pub mod engine;
pub mod http;
pub mod https;
pub mod store;
pub mod viewer_page;
pub mod viewers;
pub mod webhooks;
pub mod worker;

pub use tcgs_codec as codec;
pub use tcgs_engine::{eval, export, ingest, init, picture, pipeline, plot, ply, poses, sample, train};
pub use tcgs_render::{self as render, gpu, model};
