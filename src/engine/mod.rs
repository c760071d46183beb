//! What the service asks of the engine: checks of datasets, and views and exports of finished scenes. [`LocalEngine`] works in this
//! process, [`crate::viewers::RemoteEngine`] has viewer processes render.

mod local;

use std::{path::Path, sync::Arc};

use bytes::Bytes;
pub use local::LocalEngine;

pub use crate::pipeline::{checked_options, exported::PlacedExport};
use crate::{
    domain::{
        Camera, DatasetSummary, Digest, ExportedScene, JobNeeds, NamedCamera, Problem, ReadOptions,
        SceneFormat, TrainOptions,
    },
    pipeline::{exported::place, job_needs, scene_file},
    render::{RenderViews, views::Viewable},
};

/// The file of a finished scene.
#[derive(Clone, Copy)]
pub struct SceneSource<'a> {
    pub digest: Digest,
    /// Reads it; blocks.
    pub read: &'a dyn Fn() -> Result<Bytes, Problem>,
}

/// The engine as the service sees it. Every method but [`SceneEngine::viewers`] may block for as long as its work takes.
pub trait SceneEngine: Send + Sync {
    /// Checks a dataset archive before a scene or job is created from it.
    ///
    /// # Errors
    /// What is wrong with it, and where.
    fn check(&self, archive: &Path, read: &ReadOptions) -> Result<DatasetSummary, Problem>;

    /// What a job on a dataset needs besides time. Its memory is unknown where this process has no adapter.
    fn needs(&self, summary: &DatasetSummary, options: &TrainOptions) -> JobNeeds {
        let reason = "memory is unknown: jobs run on another machine than the one that answers";
        job_needs(summary, None, options, Err(reason.to_owned()))
    }

    /// Reads a finished scene's file of any format.
    ///
    /// # Errors
    /// What is wrong with it.
    fn load(&self, file: &[u8]) -> Result<Viewable, Problem> {
        let file = scene_file::read(file)?;
        Ok(Viewable { scene: file.scene, background: file.background })
    }

    /// The renderer of the scene in a file.
    ///
    /// # Errors
    /// If nothing renders now.
    fn renderer(&self, file: Digest) -> Result<Arc<dyn RenderViews>, Problem>;

    /// Exports a finished scene to another format and measures the export's fidelity from the dataset's cameras.
    ///
    /// # Errors
    /// 422 for a scene that the format cannot hold; faults of the device.
    fn export(
        &self,
        source: SceneSource<'_>,
        format: SceneFormat,
        cameras: &[NamedCamera],
    ) -> Result<ExportedScene, Problem>;

    /// An exported `.ply`, turned, scaled and limited in number, in any of the formats that scenes are exported to. `cameras` decide
    /// which Gaussians are kept.
    ///
    /// # Errors
    /// 422 for a scene that the format cannot hold.
    fn place(&self, ply: &[u8], export: &PlacedExport, cameras: &[Camera]) -> Result<Vec<u8>, Problem> {
        place(ply, export, cameras)
    }

    /// How many viewer processes are alive; `None` if this process renders by itself.
    fn viewers(&self) -> Option<usize>;
}
