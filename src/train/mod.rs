//! Training: the step loop, its schedule, the image loss, Adam, growth and pruning, offset masks, checkpoints.
//!
//! What always holds: the same dataset, options, seed and adapter give the same bits, because every random choice comes
//! from the seed and every sum on the device has a fixed order.

mod adam;
mod anchors;
mod batch;
pub mod budget;
mod checkpoint;
mod checkpoint_folder;
mod compression;
pub mod context;
mod densify;
mod error;
mod learner;
mod loss;
mod masks;
mod plain;
mod rate_control;
mod schedule;
mod schedule_table;
mod start_box;
mod state;
mod statistics;
mod trainer;
pub mod twin;
mod typical_distance;
mod unused;
mod wavelet;

pub use adam::{Adam, Moments};
pub use budget::{Estimate, Needs, OverBudget};
pub use checkpoint::{Checkpoint, CheckpointError};
pub use checkpoint_folder::{CheckpointFolder, KeepCheckpoints};
pub use compression::{BaseStepRule, BaseSteps, CompressionSchedule, Stage};
pub use densify::{Densify, densify};
pub use error::TrainError;
pub use loss::{ImageLoss, LossSums};
pub use masks::{FIRST_LOGIT, MaskRows, OffsetMasks};
pub use rate_control::{RateControl, RateState};
pub use schedule::{Decay, Fall, MaskSchedule, Schedule};
pub use schedule_table::schedule_table;
pub use statistics::Statistics;
pub use trainer::{Checkpoints, Trained, TrainedContext, train, train_trunk, train_within};
pub use wavelet::WaveletWeights;
