//! What renders the views and exports of a process: itself, or viewer processes.

use std::{error::Error, sync::Arc};

use tcgs::{
    domain::{Camera, Digest, ExportedScene, NamedCamera, Problem, SceneFormat, Split, SystemClock},
    export::world::Origin,
    gpu::AdapterChoice,
    http::{RendererOf, SceneExporter, SceneLoader, SceneSource, ViewerCensus},
    pipeline::scene_file,
    render::{RenderViews, views::Viewable},
    store::SqlStore,
    viewers::{self, ViewerPool},
};
use tokio::{runtime::Handle, task::JoinHandle};
use tokio_util::sync::CancellationToken;

use super::Renderer;

/// What renders the views and exports of a process.
pub(super) struct Rendering {
    pub(super) renderer: RendererOf,
    pub(super) export: SceneExporter,
    pub(super) viewers: ViewerCensus,
    /// Ends when the process shuts down.
    pub(super) watch: Option<JoinHandle<()>>,
}

/// Renders in this process.
pub(super) fn here(adapter: &AdapterChoice, memory: u64) -> Result<Rendering, Problem> {
    let (views, _) = super::views(adapter, memory)?;
    let renderer = Arc::clone(&views);
    Ok(Rendering {
        renderer: Arc::new(move |_| Ok(Arc::clone(&renderer))),
        export: exporter(views),
        viewers: Arc::new(|| None),
        watch: None,
    })
}

/// Leaves rendering to viewer processes.
pub(super) async fn elsewhere(
    store: &Arc<SqlStore>,
    shutdown: &CancellationToken,
) -> Result<Rendering, Box<dyn Error + Send + Sync>> {
    let pool = Arc::new(ViewerPool::new(store.clone(), Arc::new(SystemClock), Handle::current())?);
    pool.refresh().await;
    let watch = tokio::spawn(Arc::clone(&pool).watch(shutdown.clone()));
    let (of, counted) = (Arc::clone(&pool), Arc::clone(&pool));
    let export = move |source: SceneSource<'_>, format: SceneFormat, cameras: &[NamedCamera]| {
        viewers::export(&pool, source.digest, format, cameras)
    };
    Ok(Rendering {
        renderer: Arc::new(move |artifact: Digest| Ok(viewers::renderer(&of, artifact)?)),
        export: Arc::new(export),
        viewers: Arc::new(move || Some(counted.len())),
        watch: Some(watch),
    })
}

/// Reads files of finished scenes.
pub(super) fn loader() -> SceneLoader {
    Arc::new(|bytes: &[u8]| {
        let file = scene_file::read(bytes)?;
        Ok(Viewable { scene: file.scene, background: file.background })
    })
}

pub(super) fn exporter(views: Arc<dyn RenderViews>) -> SceneExporter {
    Arc::new(move |source, format, cameras| export(&views, source, format, cameras))
}

/// Highest degree of the spherical harmonics of scenes that are exported on demand.
const EXPORT_DEGREE: u8 = 3;

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
    let exported = super::export(&file, format, EXPORT_DEGREE, from, Origin::Nearby)?;
    let gaussians = u64::try_from(exported.gaussians).unwrap_or(u64::MAX);
    let held_out = of_split(cameras, Split::Test);
    let cameras = if held_out.is_empty() { trained } else { held_out };
    // The same key as for its views, so a scene on the device is not loaded again.
    let source = Renderer::over(Arc::clone(views), digest, file);
    let fidelity = super::fidelity(&source, &exported, &cameras).unwrap_or_else(|fault| {
        tracing::warn!("export fidelity not measured: {fault}");
        None
    });
    Ok(ExportedScene { bytes: exported.bytes, gaussians, sh_degree: exported.degree, fidelity })
}

fn of_split(cameras: &[NamedCamera], split: Split) -> Vec<Camera> {
    cameras.iter().filter(|camera| camera.split == split).map(|camera| camera.camera).collect()
}
