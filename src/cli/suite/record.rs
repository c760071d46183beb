//! Records of finished runs: lines of JSON in a file that survives an interruption.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use tcgs::domain::{Digest, JobMetrics, Problem, ProblemType, TrainOptions};

use super::external_formats::ExternalFile;
use crate::cli::CliError;

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

/// The records of a suite, kept in a file as they come.
#[derive(Debug)]
pub(crate) struct Records {
    path: PathBuf,
    all: Vec<Record>,
}

impl Records {
    /// The records of the file, none if there is no file. An incomplete last line is dropped.
    pub(crate) fn open(path: &Path) -> Result<Self, CliError> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => String::new(),
            Err(fault) => return Err(CliError::unreadable(path, &fault)),
        };
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        let mut all = Vec::new();
        for (number, line) in text[..whole].lines().enumerate() {
            let record = serde_json::from_str(line).map_err(|fault| {
                let detail = format!("line {} is not a finished run: {fault}", number + 1);
                Problem::new(ProblemType::NotResults, detail).in_file(path.display().to_string())
            })?;
            all.push(record);
        }
        if whole < text.len() {
            fs::write(path, &text[..whole]).map_err(|fault| CliError::unwritable(path, &fault))?;
        }
        Ok(Self { path: path.to_owned(), all })
    }

    /// Every record, in the order in which they came.
    pub(crate) fn all(&self) -> &[Record] {
        &self.all
    }

    /// Appends one to the file and returns it as read back, so that a resumed suite has the same figures to the last digit.
    pub(crate) fn add(&mut self, record: &Record) -> Result<Record, CliError> {
        let unwritable = |fault: io::Error| CliError::unwritable(&self.path, &fault);
        let mut line = serde_json::to_vec(record).map_err(|fault| unwritable(fault.into()))?;
        let kept: Record = serde_json::from_slice(&line).map_err(|fault| unwritable(fault.into()))?;
        line.push(b'\n');
        let mut file =
            fs::OpenOptions::new().create(true).append(true).open(&self.path).map_err(unwritable)?;
        file.write_all(&line).and_then(|()| file.sync_all()).map_err(unwritable)?;
        self.all.push(kept.clone());
        Ok(kept)
    }
}
