//! The one place where the command line meets the engines: codec, training, rendering, measuring, service.
//!
//! Each command speaks to the functions below and to nothing behind them, so that an engine can be exchanged here
//! without a change to any command. Faults arrive as [`Problem`]s.

use std::{net::SocketAddr, path::Path, path::PathBuf};

use tcgs::{
    codec::{EncodeSettings, Encoded},
    domain::{AnchorScene, Background, ByteCounts, Camera, Dataset, Digest, Image, Problem, Scores},
    gpu::AdapterChoice,
    ingest,
    worker::run::RunJob,
};

use super::Failure;

/// Quantisation step of features where a user gives none (the published one).
pub(crate) const FEATURE_STEP: f32 = 1.0;
/// Quantisation step of scalings as a fraction of the voxel where a user gives none.
pub(crate) const SCALING_STEP: f32 = 0.05;
/// Quantisation step of offsets where a user gives none (the published one).
pub(crate) const OFFSET_STEP: f32 = 0.2;

/// What a file decodes to.
#[derive(Debug)]
pub(crate) struct Decoded {
    pub(crate) scene: AnchorScene,
    pub(crate) background: Background,
    pub(crate) decode_sha256: Digest,
}

/// What is known of a file without decoding its attributes.
#[derive(Debug)]
pub(crate) struct Inspection {
    /// The whole account as JSON.
    pub(crate) json: serde_json::Value,
    /// The same as a table.
    pub(crate) text: String,
    /// Bytes by kind.
    pub(crate) bytes: ByteCounts,
}

/// Where a service listens and keeps its data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ServeOptions {
    pub(crate) listen: SocketAddr,
    pub(crate) data: PathBuf,
    pub(crate) adapter: AdapterChoice,
    /// Worker processes to start.
    pub(crate) workers: u16,
}

/// Where a worker finds its queue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WorkerOptions {
    /// The data folder of the service.
    pub(crate) data: PathBuf,
    pub(crate) adapter: AdapterChoice,
    /// Whether to stop when standard input closes, which it does when the parent process dies.
    pub(crate) stop_with_parent: bool,
}

/// Reads a dataset.
pub(crate) fn load_dataset(path: &Path) -> Result<Dataset, Problem> {
    ingest::load(path)
}

/// Encodes a scene.
pub(crate) fn encode(_scene: &AnchorScene, _settings: &EncodeSettings) -> Result<Encoded, Problem> {
    Err(absent("encoding"))
}

/// Decodes a file.
pub(crate) fn decode(_bytes: &[u8]) -> Result<Decoded, Problem> {
    Err(absent("decoding"))
}

/// Accounts for every byte of a file.
pub(crate) fn inspect(_bytes: &[u8]) -> Result<Inspection, Problem> {
    Err(absent("inspecting"))
}

/// The training pipeline.
pub(crate) fn runner(_adapter: &AdapterChoice) -> Result<Box<dyn RunJob>, Problem> {
    Err(absent("training"))
}

/// Renders the scene that it holds from a camera.
type View = Box<dyn Fn(&Camera) -> Result<Image, Problem>>;

/// Renders one scene, as many cameras as are asked for.
pub(crate) struct Renderer {
    /// Adapter and driver in one line.
    pub(crate) adapter: String,
    view: View,
}

impl Renderer {
    /// Opens the adapter for the scene of a decoded file.
    pub(crate) fn open(_decoded: Decoded, _adapter: &AdapterChoice) -> Result<Self, Problem> {
        Err(absent("rendering"))
    }

    /// The view from `camera`, over the background that the scene was trained on.
    pub(crate) fn view(&self, camera: &Camera) -> Result<Image, Problem> {
        (self.view)(camera)
    }
}

/// Scores of renders against photographs, pair by pair.
pub(crate) fn scores(_pairs: &[(Image, Image)]) -> Result<Scores, Problem> {
    Err(absent("measuring"))
}

/// Runs the service until it is told to stop.
pub(crate) fn serve(_options: ServeOptions) -> Result<(), Failure> {
    Err(absent("serving").into())
}

/// Runs a worker until it is told to stop.
pub(crate) fn worker(_options: WorkerOptions) -> Result<(), Failure> {
    Err(absent("working").into())
}

fn absent(what: &str) -> Problem {
    Problem::new(501, "not-built", "Not built", format!("{what} is not part of this build"))
}
