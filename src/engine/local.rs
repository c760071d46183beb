//! The engine in this process.

use std::{path::Path, sync::Arc};

use super::{SceneEngine, SceneSource};
use crate::{
    domain::{
        Camera, DatasetSummary, Digest, ExportedScene, JobNeeds, NamedCamera, Problem, ReadOptions,
        SceneFormat, Split, TrainOptions,
    },
    ingest::DatasetChecker,
    pipeline::{
        Machine,
        exported::{ExportSettings, export as export_scene, fidelity},
        job_needs, scene_file,
        scene_views::SceneViews,
    },
    render::RenderViews,
};

/// Checks datasets, renders and exports in this process.
pub struct LocalEngine {
    checker: DatasetChecker,
    views: Arc<dyn RenderViews>,
    machine: Option<Machine>,
}

impl LocalEngine {
    /// With what checks datasets and what renders.
    #[must_use]
    pub fn new(checker: DatasetChecker, views: Arc<dyn RenderViews>) -> Self {
        Self { checker, views, machine: None }
    }

    /// With the machine that jobs run on.
    #[must_use]
    pub fn with_machine(self, machine: Machine) -> Self {
        Self { machine: Some(machine), ..self }
    }
}

impl SceneEngine for LocalEngine {
    fn check(&self, archive: &Path, read: &ReadOptions) -> Result<DatasetSummary, Problem> {
        self.checker.check(archive, read)
    }

    fn needs(&self, summary: &DatasetSummary, options: &TrainOptions) -> JobNeeds {
        let unknown = || "memory is unknown: the machine that jobs run on is not known".to_owned();
        job_needs(summary, None, options, self.machine.as_ref().ok_or_else(unknown))
    }

    fn renderer(&self, _: Digest) -> Result<Arc<dyn RenderViews>, Problem> {
        Ok(Arc::clone(&self.views))
    }

    fn export(
        &self,
        source: SceneSource<'_>,
        format: SceneFormat,
        cameras: &[NamedCamera],
    ) -> Result<ExportedScene, Problem> {
        export(&self.views, source, format, cameras)
    }

    fn viewers(&self) -> Option<usize> {
        None
    }
}

/// A finished scene in another format, fitted to its renders from the training cameras, or from a sphere if there are none.
fn export(
    views: &Arc<dyn RenderViews>,
    source: SceneSource<'_>,
    format: SceneFormat,
    cameras: &[NamedCamera],
) -> Result<ExportedScene, Problem> {
    let SceneSource { digest, read } = source;
    let file = scene_file::read(&read()?)?;
    let trained = of_split(cameras, Split::Train);
    let from = (!trained.is_empty()).then_some(&*trained);
    let exported = export_scene(&file, &ExportSettings::whole(format), from)?;
    let gaussians = u64::try_from(exported.gaussians).unwrap_or(u64::MAX);
    let held_out = of_split(cameras, Split::Test);
    let cameras = if held_out.is_empty() { trained } else { held_out };
    // The same key as for its views, so a scene on the device is not loaded again.
    let source = SceneViews::over(Arc::clone(views), digest, file);
    let fidelity = fidelity(&source, &exported, &cameras).unwrap_or_else(|error| {
        tracing::warn!("export fidelity not measured: {error}");
        None
    });
    Ok(ExportedScene { bytes: exported.bytes, gaussians, sh_degree: exported.degree, fidelity })
}

fn of_split(cameras: &[NamedCamera], split: Split) -> Vec<Camera> {
    cameras.iter().filter(|camera| camera.split == split).map(|camera| camera.camera).collect()
}
