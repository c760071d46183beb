//! Training: the step loop, its schedule, the image loss, Adam, growth and pruning, offset masks, checkpoints.
//!
//! What always holds: the same dataset, options, seed and adapter give the same bits, because every random choice comes
//! from the seed and every sum on the device has a fixed order.

mod adam;
mod anchor_trainer;
mod base_quant_steps;
mod batch;
pub mod budget;
mod checkpoint;
mod compression;
pub mod context;
mod densify;
mod error;
mod init_bounds;
mod loss;
mod masks;
mod model_trainer;
mod plain;
mod prune_invisible;
mod rate_control;
mod schedule;
mod statistics;
mod trainer;
pub mod twin;
mod typical_distance;
mod wavelet;

pub use adam::{Adam, Moments};
pub use base_quant_steps::BaseSteps;
pub use budget::{Estimate, Needs, OverBudget};
pub use checkpoint::{Checkpoint, CheckpointError, CheckpointFolder, KeepCheckpoints};
pub use densify::{Densify, densify};
pub use error::TrainError;
pub use loss::{ImageLoss, LossSums};
pub use masks::{FIRST_LOGIT, MaskRows, OffsetMasks};
pub use rate_control::{RateControl, RateState};
pub use schedule::{
    BaseStepRule, CompressionSchedule, Decay, Fall, MaskSchedule, Schedule, Stage, schedule_table,
};
pub use statistics::Statistics;
pub use trainer::{Checkpoints, Trained, TrainedContext, train, train_trunk, train_within};
pub use wavelet::WaveletWeights;
