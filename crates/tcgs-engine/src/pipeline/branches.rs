//! Finished branches of a rate-distortion curve in the folder of the run's checkpoints, so that an interruption repeats at most
//! one branch.
//!
//! A branch has a folder of its own beside the trunk's checkpoint, with its checkpoint while it runs, then its file and a record.
//! They are used only if they are intact and were written by the same version of the program for the same dataset and options.

use std::{
    fs,
    io::{self, Write as _},
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use tempfile::NamedTempFile;

use crate::domain::{Digest, JobMetrics, TrainOptions};

/// The record, written last: if it is there, so is the file.
const RECORD: &str = "finished.json";
const FILE: &str = "finished.tcgs";
const GENERATOR: &str = concat!("tcgs ", env!("CARGO_PKG_VERSION"));

/// What a branch was made from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Identity {
    generator: String,
    dataset: Digest,
    /// As text, since parsing does not always preserve numbers.
    options: String,
}

impl Identity {
    fn new(dataset: Digest, options: &TrainOptions) -> io::Result<Self> {
        Ok(Self { generator: GENERATOR.to_owned(), dataset, options: serde_json::to_string(options)? })
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct Record {
    identity: Identity,
    sha256: Digest,
    metrics: JobMetrics,
}

/// A finished branch.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FinishedBranch {
    pub(super) file: Vec<u8>,
    pub(super) metrics: JobMetrics,
}

/// The folder of branch `number` of the run whose checkpoints are in `root`.
pub(super) fn folder(root: &Path, number: usize) -> PathBuf {
    root.join(format!("branch-{number}"))
}

/// Writes a finished branch to its folder; its checkpoint is then no longer needed.
pub(super) fn keep(
    folder: &Path,
    dataset: Digest,
    options: &TrainOptions,
    finished: &FinishedBranch,
) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let record = Record {
        identity: Identity::new(dataset, options)?,
        sha256: Digest::of(&finished.file),
        metrics: finished.metrics.clone(),
    };
    write(&folder.join(FILE), &finished.file)?;
    write(&folder.join(RECORD), &serde_json::to_vec(&record)?)
}

/// Replaces the file at `path` atomically.
fn write(path: &Path, content: &[u8]) -> io::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut file = NamedTempFile::new_in(folder)?;
    file.write_all(content)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    Ok(())
}

/// The finished branch in `folder`, if it is intact and was made from this dataset and these options.
pub(super) fn load(folder: &Path, dataset: Digest, options: &TrainOptions) -> Option<FinishedBranch> {
    let record = fs::read(folder.join(RECORD)).ok()?;
    let record: Record = serde_json::from_slice(&record).ok()?;
    let file = fs::read(folder.join(FILE)).ok()?;
    let matches =
        record.identity == Identity::new(dataset, options).ok()? && record.sha256 == Digest::of(&file);
    matches.then_some(FinishedBranch { file, metrics: record.metrics })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Background, ByteCounts, Conventions, PhaseSeconds, Scores};

    fn finished() -> FinishedBranch {
        let scores = Scores {
            psnr: Some(30.25),
            ssim: None,
            lpips: None,
            lpips_network: None,
            views: 0,
            per_view: Vec::new(),
        };
        let metrics = JobMetrics {
            test: scores.clone(),
            train: scores,
            bytes: ByteCounts::default(),
            seconds: PhaseSeconds::default(),
            steps: 10,
            steps_per_second: 5.0,
            view_pixels: None,
            anchors: 1,
            gaussians: 1,
            psnr_before_quantisation: None,
            decode_sha256: Digest::of(b"decoded"),
            adapter: "an adapter".to_owned(),
            background: Background::White,
            conventions: Conventions::new(None),
            byte_budget: None,
            convergence: None,
            coding: None,
            stages: None,
            rendering: None,
            frame: None,
            color_fit: None,
            exposure: None,
            crop: None,
            rd_curve: Vec::new(),
        };
        FinishedBranch { file: b"a file".to_vec(), metrics }
    }

    #[test]
    fn a_finished_branch_is_read_back_intact_or_not_at_all() {
        let root = tempfile::tempdir().expect("a folder");
        let folder = folder(root.path(), 3);
        let (set, options) =
            (Digest::of(b"set"), TrainOptions { lambda: Some(0.1), ..TrainOptions::default() });
        assert_eq!(load(&folder, set, &options), None);
        keep(&folder, set, &options, &finished()).expect("kept");
        assert_eq!(load(&folder, set, &options), Some(finished()));
        assert_eq!(fs::read_dir(&folder).expect("a folder").count(), 2, "nothing is left beside them");
        assert_eq!(load(&folder, Digest::of(b"other"), &options), None);
        assert_eq!(load(&folder, set, &TrainOptions { lambda: Some(0.2), ..options.clone() }), None);
        fs::write(folder.join(FILE), b"a torn").expect("writes");
        assert_eq!(load(&folder, set, &options), None);
        keep(&folder, set, &options, &finished()).expect("kept again");
        fs::write(folder.join(RECORD), b"{").expect("writes");
        assert_eq!(load(&folder, set, &options), None);
    }
}
