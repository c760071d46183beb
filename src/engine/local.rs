//! The engine in this process.

use std::{
    path::Path,
    sync::{Arc, Mutex, PoisonError},
};

use super::{SceneEngine, SceneSource};
use crate::{
    domain::{
        Camera, DatasetSummary, Digest, ExportedScene, JobNeeds, NamedCamera, Problem, ReadOptions,
        SceneFormat, Split, TrainOptions,
    },
    ingest::DatasetChecker,
    pipeline::{
        Machine,
        exported::{ExportSettings, PlainScene, Refiner, fidelity, plain, write},
        job_needs,
        scene_file::{self, SceneFile},
        scene_views::SceneViews,
    },
    render::RenderViews,
};

/// Checks datasets, renders and exports in this process.
pub struct LocalEngine {
    checker: DatasetChecker,
    views: Arc<dyn RenderViews>,
    machine: Option<Machine>,
    refiner: Option<Refiner>,
    /// The scene that was baked last: who exports one to a format often wants another.
    baked: Mutex<Option<Baked>>,
}

/// A baked scene, and what it was baked from.
struct Baked {
    file: Digest,
    cameras: Vec<Camera>,
    plain: PlainScene,
}

impl LocalEngine {
    /// With what checks datasets and what renders.
    #[must_use]
    pub fn new(checker: DatasetChecker, views: Arc<dyn RenderViews>) -> Self {
        Self { checker, views, machine: None, refiner: None, baked: Mutex::default() }
    }

    /// With the machine that jobs run on.
    #[must_use]
    pub fn with_machine(self, machine: Machine) -> Self {
        Self { machine: Some(machine), ..self }
    }

    /// With what refines exports.
    #[must_use]
    pub fn with_refiner(self, refiner: Refiner) -> Self {
        Self { refiner: Some(refiner), ..self }
    }

    /// The scene as plain Gaussians. One scene is baked at a time.
    fn plain(&self, digest: Digest, file: &SceneFile, cameras: &[Camera]) -> Result<PlainScene, Problem> {
        let mut kept = self.baked.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(Baked { plain, .. }) =
            kept.as_ref().filter(|kept| kept.file == digest && kept.cameras == cameras)
        {
            return Ok(plain.clone());
        }
        let degree = ExportSettings::whole(SceneFormat::Ply).degree;
        let from = (!cameras.is_empty()).then_some(cameras);
        let plain = plain(file, degree, from, self.refiner.as_ref())?;
        *kept = plain.baking.map(|_| Baked { file: digest, cameras: cameras.to_vec(), plain: plain.clone() });
        Ok(plain)
    }

    /// A finished scene in another format, fitted to its renders from the training cameras, or from a sphere if there are none.
    fn exported(
        &self,
        source: SceneSource<'_>,
        format: SceneFormat,
        cameras: &[NamedCamera],
    ) -> Result<ExportedScene, Problem> {
        let SceneSource { digest, read } = source;
        let file = scene_file::read(&read()?)?;
        let trained = of_split(cameras, Split::Train);
        let plain = self.plain(digest, &file, &trained)?;
        let from = (!trained.is_empty()).then_some(&*trained);
        let exported = write(&file, plain, &ExportSettings::whole(format), from)?;
        let gaussians = u64::try_from(exported.gaussians).unwrap_or(u64::MAX);
        let held_out = of_split(cameras, Split::Test);
        let cameras = if held_out.is_empty() { trained } else { held_out };
        // The same key as for its views, so a scene on the device is not loaded again.
        let source = SceneViews::over(Arc::clone(&self.views), digest, file);
        let fidelity = fidelity(&source, &exported, &cameras).unwrap_or_else(|error| {
            tracing::warn!("export fidelity not measured: {error}");
            None
        });
        Ok(ExportedScene { bytes: exported.bytes, gaussians, sh_degree: exported.degree, fidelity })
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
        self.exported(source, format, cameras)
    }

    fn viewers(&self) -> Option<usize> {
        None
    }
}

fn of_split(cameras: &[NamedCamera], split: Split) -> Vec<Camera> {
    cameras.iter().filter(|camera| camera.split == split).map(|camera| camera.camera).collect()
}
