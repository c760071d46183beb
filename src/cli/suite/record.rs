//! What a suite keeps of a finished run.

use serde::{Deserialize, Serialize};
use tcgs::domain::{Digest, JobMetrics, TrainOptions};

use super::external_formats::ExternalFile;

/// What is equal in the runs compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Comparison {
    /// The same number of steps.
    Steps,
    /// The same seconds of training.
    Seconds,
}

/// A finished run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Record {
    /// Name of the set.
    pub(crate) set: String,
    /// Digest of its content.
    pub(crate) dataset: Digest,
    /// What is equal in the runs compared.
    #[serde(rename = "contest")]
    pub(crate) comparison: Comparison,
    /// The entry's name.
    pub(crate) entry: String,
    /// The seconds that the run had to fill, if any.
    pub(crate) budget: Option<f64>,
    /// Its options.
    pub(crate) options: TrainOptions,
    /// Mean error of held-out views in the high wavelet bands.
    pub(crate) high_band: Option<f64>,
    /// The figures of the written file.
    pub(crate) metrics: JobMetrics,
    /// The same scene in other programs' formats, if requested.
    #[serde(rename = "peers", default)]
    pub(crate) external_formats: Vec<ExternalFile>,
}

impl Record {
    /// Whether it is a run of the same entry and set, whatever its steps and seconds.
    pub(crate) fn is_like(&self, other: &Wanted<'_>) -> bool {
        let options = TrainOptions { iterations: other.options.iterations, ..self.options.clone() };
        self.set == other.set
            && self.dataset == other.dataset
            && self.entry == other.entry
            && options == *other.options
    }
}

/// The key of a record.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wanted<'a> {
    pub(crate) set: &'a str,
    pub(crate) dataset: Digest,
    pub(crate) entry: &'a str,
    pub(crate) options: &'a TrainOptions,
}
