//! From a dataset of posed photographs to a measured `.tcgs` file: reading, training, compression, evaluation and export.

pub mod domain;
pub mod eval;
pub mod export;
pub mod ingest;
pub mod init;
pub mod picture;
pub mod pipeline;
pub mod plot;
pub mod ply;
pub mod sample;
pub mod train;

use tcgs_codec as codec;
use tcgs_render::{self as render, gpu, model};
