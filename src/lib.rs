//! `tcgs` trains anchor-based Gaussian-splatting scenes from posed photographs on any wgpu adapter,
//! compresses them with the TC-GS method into one self-contained file, and serves the result over HTTP.
//!
//! To read such files in another program, depend on this crate with `default-features = false`: that leaves [`codec`]
//! and [`domain`], without wgpu, tokio or SQL, on any target of Rust's standard library, WebAssembly included. The feature
//! `service`, on by default, adds the rest.
//!
//! The modules below are the layers, lowest first; a module may use only the layers named in
//! `tests/it/layers.rs`, which reads every `use crate::` line and holds that table.

#[cfg(feature = "service")]
pub mod accuracy;
pub mod codec;
pub mod domain;
#[cfg(feature = "service")]
pub mod eval;
#[cfg(feature = "service")]
pub mod export;
#[cfg(feature = "service")]
pub mod gpu;
#[cfg(feature = "service")]
pub mod http;
#[cfg(feature = "service")]
pub mod https;
#[cfg(feature = "service")]
pub mod ingest;
#[cfg(feature = "service")]
pub mod model;
#[cfg(feature = "service")]
pub mod picture;
#[cfg(feature = "service")]
pub mod pipeline;
#[cfg(feature = "service")]
pub mod plot;
#[cfg(feature = "service")]
pub mod ply;
#[cfg(feature = "service")]
pub mod render;
#[cfg(feature = "service")]
pub mod sample;
#[cfg(feature = "service")]
pub mod store;
#[cfg(feature = "service")]
pub mod train;
#[cfg(feature = "service")]
pub mod viewers;
#[cfg(feature = "service")]
pub mod webhooks;
#[cfg(feature = "service")]
pub mod worker;
