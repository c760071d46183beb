//! Training: the training loop, its schedule, the image loss, color corrections, Adam, growth and pruning, offset masks, checkpoints.
//!
//! Invariant: the same dataset, options, seed and adapter give the same bits: every random choice comes from the seed, and every
//! sum on the device has a fixed order.

mod adam;
mod anchor_stage;
mod anchor_trainer;
mod base_quant_steps;
mod batch;
pub mod budget;
mod channel_pruning;
mod checkpoint;
mod compression;
pub mod context;
mod densify;
mod error;
mod exposure;
mod feature_basis;
mod footprint;
mod init_bounds;
mod loss;
mod mask_weight;
mod masks;
mod memory_estimate;
mod model_trainer;
mod monitor;
mod photographs;
mod plain;
mod prune_invisible;
mod rate_control;
mod refine;
mod removal_losses;
mod scene_extent;
mod scene_frame;
mod schedule;
mod sensitivity;
mod set_sizes;
mod statistics;
mod trained;
mod trainer;
pub mod twin;
mod typical_distance;
mod wavelet;

pub use adam::{Adam, AdamStep, Moments};
pub use base_quant_steps::BaseQuantSteps;
pub use budget::Needs;
pub use checkpoint::{Checkpoint, CheckpointError, CheckpointFolder, CheckpointSink};
pub use compression::{ContextFitSettings, fit_contexts};
pub use densify::{DensifySettings, densify};
use error::Result;
pub use error::{ContextError, TrainError};
pub use exposure::{ColorCorrections, Learning};
pub use loss::{ImageLoss, LossSums};
pub use mask_weight::MaskWeightGrowth;
pub use masks::{FIRST_LOGIT, MaskRows, OffsetMasks};
pub use memory_estimate::{Estimate, OverBudget, PhotographPlace, PhotographTooLarge, RunTooLarge};
pub use rate_control::{RateControl, RateControlState, SizeAim, SizeLimit};
pub use refine::Refinement;
pub use schedule::{
    BaseQuantStepRule, CompressionSchedule, CompressionStage, Decay, DecayShape, MaskSchedule, Schedule,
    schedule_table,
};
pub use set_sizes::SetSizes;
pub use statistics::Statistics;
pub use trained::{Trained, TrainedContext};
pub use trainer::{Checkpoints, STEP_RECORDING, Trainer};
pub use wavelet::WaveletWeights;
