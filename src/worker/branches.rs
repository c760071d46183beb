//! Finished branches of a rate-distortion curve in the folder of the run's checkpoints, so that an interruption costs no more
//! than the branch that it fell into.
//!
//! A branch has a folder of its own beside the trunk's checkpoint: its checkpoint while it runs, then its file and its
//! figures. What is read back is used only if it is whole and of the same program, dataset and options.

use std::{
    fs,
    io::{self, Write as _},
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use tempfile::NamedTempFile;

use crate::domain::{Digest, JobMetrics, TrainOptions};

/// The figures, written last: where they are, the file is.
const FIGURES: &str = "finished.json";
/// The file.
const FILE: &str = "finished.tcgs";
/// What wrote them.
const GENERATOR: &str = concat!("tcgs ", env!("CARGO_PKG_VERSION"));

/// What belongs to one branch and no other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Identity {
    generator: String,
    dataset: Digest,
    /// As text, since numbers do not always survive being parsed.
    options: String,
}

impl Identity {
    fn new(dataset: Digest, options: &TrainOptions) -> io::Result<Self> {
        Ok(Self { generator: GENERATOR.to_owned(), dataset, options: serde_json::to_string(options)? })
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct Figures {
    identity: Identity,
    sha256: Digest,
    metrics: JobMetrics,
}

/// A branch that is done.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Finished {
    pub(super) file: Vec<u8>,
    pub(super) metrics: JobMetrics,
}

/// The folder of branch `number` of the run whose checkpoints are in `root`.
pub(super) fn folder(root: &Path, number: usize) -> PathBuf {
    root.join(format!("branch-{number}"))
}

/// Keeps a finished branch, whose checkpoint nobody needs any more.
pub(super) fn keep(
    folder: &Path,
    dataset: Digest,
    options: &TrainOptions,
    finished: &Finished,
) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let figures = Figures {
        identity: Identity::new(dataset, options)?,
        sha256: Digest::of(&finished.file),
        metrics: finished.metrics.clone(),
    };
    write(&folder.join(FILE), &finished.file)?;
    write(&folder.join(FIGURES), &serde_json::to_vec(&figures)?)
}

/// Replaces the file at `path` by a whole one.
fn write(path: &Path, content: &[u8]) -> io::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut file = NamedTempFile::new_in(folder)?;
    file.write_all(content)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    Ok(())
}

/// The finished branch in `folder`, if there is one of these options.
pub(super) fn load(folder: &Path, dataset: Digest, options: &TrainOptions) -> Option<Finished> {
    let figures = fs::read(folder.join(FIGURES)).ok()?;
    let figures: Figures = serde_json::from_slice(&figures).ok()?;
    let file = fs::read(folder.join(FILE)).ok()?;
    let is_it =
        figures.identity == Identity::new(dataset, options).ok()? && figures.sha256 == Digest::of(&file);
    is_it.then_some(Finished { file, metrics: figures.metrics })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Background, ByteCounts, Conventions, PhaseSeconds, Scores};

    fn finished() -> Finished {
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
            anchors: 1,
            gaussians: 1,
            psnr_before_quantisation: None,
            decode_sha256: Digest::of(b"decoded"),
            adapter: "an adapter".to_owned(),
            background: Background::White,
            conventions: Conventions::new(None),
            byte_budget: None,
            coding: None,
            rd_curve: Vec::new(),
        };
        Finished { file: b"a file".to_vec(), metrics }
    }

    #[test]
    fn a_finished_branch_comes_back_whole_or_not_at_all() {
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
        fs::write(folder.join(FIGURES), b"{").expect("writes");
        assert_eq!(load(&folder, set, &options), None);
    }
}
