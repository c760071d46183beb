//! From a dataset of posed photographs to a measured `.tcgs` file: reading, training, compression, evaluation and export.
//!
//! A program needs [`Dataset::load`], [`Trainer`] and [`encode`]; [`Pipeline`] does all three and measures the file. Rendering is the
//! crate `tcgs-render`. Modules that this page does not list serve the service and the laboratory of `tcgs`, and change without notice.

#![warn(missing_docs)]

pub mod domain;
#[doc(hidden)]
pub mod eval;
#[doc(hidden)]
pub mod export;
#[doc(hidden)]
pub mod ingest;
#[doc(hidden)]
pub mod init;
pub mod picture;
pub mod pipeline;
#[doc(hidden)]
pub mod plot;
#[doc(hidden)]
pub mod ply;
#[doc(hidden)]
pub mod poses;
#[doc(hidden)]
pub mod sample;
#[doc(hidden)]
pub mod train;

#[doc(inline)]
pub use self::{
    domain::{Dataset, TrainOptions},
    pipeline::{Pipeline, encode},
    train::{
        Checkpoint, CheckpointError, CheckpointFolder, CheckpointSink, Checkpoints, TrainError, Trained,
        Trainer,
    },
};

use tcgs_codec as codec;
use tcgs_render::{self as render, gpu, model};

/// The example of the readme compiles.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
