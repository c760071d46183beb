//! How runs went that earlier versions could end early. Results that are stored still say so; nothing makes new ones.

use serde::{Deserialize, Serialize};

/// Mean PSNR of the views kept aside at a step of the run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ValidationScore {
    /// Steps done.
    pub step: u64,
    /// dB, of the scene as that step renders it.
    pub psnr: f64,
}

/// How a run with `until=converged` went.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Convergence {
    /// Names of the training views that were kept aside; empty if the dataset has too few views.
    pub views: Vec<String>,
    /// Their scores in the course of the run.
    pub scores: Vec<ValidationScore>,
    /// The step after which the run was found to have converged; null if it was not, and took its full length.
    pub converged_at: Option<u64>,
    /// The best smoothed score until then, in dB.
    pub psnr: Option<f64>,
    /// Steps of the full schedule.
    pub full_steps: u64,
    /// Steps not taken.
    pub steps_saved: u64,
    /// Seconds saved, an estimate: `steps_saved` at the mean speed of the run.
    pub seconds_saved: f64,
    /// dB given up, an estimate: the gain of the last tenth of the run, extrapolated over `steps_saved`.
    pub psnr_given_up: Option<f64>,
}
