//! The note on a dataset whose cameras this program found: `poses.json`, which `poses` writes beside the model.

use serde::{Deserialize, de::IgnoredAny};

use super::{bounded_json, error::shown, tree::Tree};

/// The file.
pub const POSES_RECORD: &str = "poses.json";

/// Most bytes of the file: a name for each of the most photographs.
const MAX_BYTES: u64 = 16 << 20;

/// The parts of the record that the note has.
#[derive(Deserialize)]
struct Record {
    photographs: u64,
    registered: Vec<IgnoredAny>,
    reprojection_error: f64,
    generator: String,
    options: Options,
}

#[derive(Deserialize)]
struct Options {
    camera_model: String,
    seed: u64,
    threads: u64,
}

/// How the cameras were found; `None` if another program wrote the dataset.
pub(super) fn note(tree: &Tree) -> Option<String> {
    if !tree.has(POSES_RECORD) {
        return None;
    }
    let record =
        tree.parse(POSES_RECORD, MAX_BYTES, |reader, _| bounded_json::read::<Record>(reader)).ok()?;
    let Record { photographs, registered, reprojection_error, generator, options } = record;
    let Options { camera_model, seed, threads } = options;
    Some(format!(
        "cameras of {} of {photographs} photographs were found by {} ({}, seed {seed}, {threads} threads); the mean reprojection error is \
         {reprojection_error:.2} px",
        registered.len(),
        shown(&generator),
        shown(&camera_model),
    ))
}
