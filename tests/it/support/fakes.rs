//! Stand-ins for training, rendering, decoding and the dataset check, steered by what they are given.

use std::{
    fs,
    path::Path,
    sync::{
        Arc, Condvar, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use glam::DVec3;
use tcgs::{
    domain::{
        AnchorScene, Background, ByteCounts, Camera, CancelFlag, CodingEfficiency, CodingStages,
        ColorFitScores, Conventions, Crop, CropCost, CurvePoint, DatasetSummary, Digest, ExportFidelity,
        ExportedScene, ExposureChoice, ExposureTrial, HeldOut, HeldOutView, Image, Intrinsics, JobId,
        JobMetrics, JobNeeds, Lattice, Layout, LpipsNetwork, MaskSource, MemoryNeeds, Mlp, NamedCamera,
        NearPlane, Phase, PhaseSeconds, Pose, Preview, Problem, ProblemType, Progress, ReadOptions,
        RenderNetworks, RenderingError, Scene, SceneFormat, SceneFrame, SceneScale, Scores, Split,
        TrainOptions, ValueRange, ViewScore, WorkerCounts, Workers,
    },
    engine::{PlacedExport, SceneEngine, SceneSource},
    pipeline::{CheckpointPlan, CurveFile, JobError, JobOutput, RunJob},
    render::{
        RenderViews,
        views::{ScalarImage, ScalarKind, Viewable},
    },
};

use super::eventually::{PATIENCE, within};

/// A door that runs and renders can be made to wait at.
#[derive(Debug, Default)]
pub struct Gate {
    open: Mutex<bool>,
    changed: Condvar,
    arrived: tokio::sync::Notify,
}

impl Gate {
    /// Lets everyone through, now and later.
    pub fn open(&self) {
        *self.open.lock().expect("not poisoned") = true;
        self.changed.notify_all();
    }

    /// Waits until somebody stands at the gate.
    pub async fn someone_waits(&self) {
        within("somebody stands at the gate", self.arrived.notified()).await;
    }

    fn is_open(&self) -> bool {
        *self.open.lock().expect("not poisoned")
    }

    pub fn pass(&self) {
        self.arrived.notify_one();
        let mut open = self.open.lock().expect("not poisoned");
        while !*open {
            let (guard, waited) = self.changed.wait_timeout(open, PATIENCE).expect("not poisoned");
            assert!(!waited.timed_out(), "nobody opens the gate");
            open = guard;
        }
    }
}

/// The `.tcgs` file of every fake job.
pub const FILE: &[u8] = b"this is not really a compressed scene, but it has bytes";

/// Does what the dataset's text says: `succeed`, `fail`, `retry`, `panic`, `wait` (until cancelled), `gate`
/// (until the gate opens, whatever the cancel flag says), `hold` (for want of room, until the gate is open), then a suffix that makes datasets differ.
#[derive(Debug, Default, Clone)]
pub struct FakeRunner {
    pub gate: Arc<Gate>,
}

impl RunJob for FakeRunner {
    fn run(
        &self,
        dataset: &Path,
        options: &TrainOptions,
        _checkpoints: &CheckpointPlan,
        report: &mut dyn FnMut(Phase, &Progress),
        cancel: &CancelFlag,
    ) -> Result<JobOutput, JobError> {
        let wish = fs::read(dataset).expect("the dataset is readable");
        // A real archive is as good as a wish to succeed.
        let wish = if wish.starts_with(b"PK") {
            "succeed".to_owned()
        } else {
            String::from_utf8(wish).expect("text")
        };
        tracing::info!("the run begins");
        let problem = || Problem::new(ProblemType::WorkerPanicked, "as the test wants it");
        let total = u64::from(options.iterations.unwrap_or(10));
        report(Phase::Train, &Progress { step: 1, total, loss: Some(0.5), ..Progress::default() });
        match wish.split_whitespace().next().unwrap_or_default() {
            "succeed" => {}
            "fail" => return Err(JobError::Fail(problem())),
            "retry" => return Err(JobError::Retry(problem())),
            "hold" if self.gate.is_open() => {}
            "hold" => {
                let detail = "there is no room in /srv/tcgs for 3 bytes more";
                return Err(JobError::Hold(Problem::new(ProblemType::StorageFull, detail)));
            }
            "panic" => panic!("as the test wants it"),
            "wait" => {
                self.gate.arrived.notify_one();
                let mut step = 1;
                let photograph = Arc::new(flat(8, 6, 77));
                while !cancel.is_cancelled() {
                    step += 1;
                    let preview = Some(preview(step, &photograph));
                    report(Phase::Train, &Progress { step, total, preview, ..Progress::default() });
                    std::thread::sleep(Duration::from_millis(2));
                }
                return Err(JobError::Cancelled);
            }
            "gate" => self.gate.pass(),
            other => panic!("the test wants '{other}'"),
        }
        report(Phase::Encode, &Progress { step: total, total, ..Progress::default() });
        let points = options.rd_curve.iter().enumerate().map(|(place, lambda)| CurvePoint {
            lambda: *lambda,
            bytes: curve_file(place).len() as u64,
            psnr: Some(30.0),
            ssim: Some(0.9),
            lpips: None,
            gaussians: 1,
            sha256: Digest::of(&curve_file(place)),
        });
        let others = options.rd_curve.iter().enumerate().skip(1);
        Ok(JobOutput {
            file: FILE.to_vec(),
            format: SceneFormat::of_model(options.model),
            others: others.map(|(place, &lambda)| CurveFile { lambda, file: curve_file(place) }).collect(),
            metrics: JobMetrics { rd_curve: points.collect(), ..metrics() },
            cameras: cameras(),
            held_out: Some(held_out()),
            thumbnail: Some(THUMBNAIL.to_vec()),
        })
    }
}

/// The thumbnail of every fake job, by its first bytes a JPEG.
pub const THUMBNAIL: &[u8] = b"\xff\xd8\xff thumbnail";

/// A picture of one gray.
fn flat(width: u32, height: u32, level: u8) -> Image {
    Image::new(width, height, 3, vec![level; (3 * width * height) as usize]).expect("an image")
}

/// A picture that differs from step to step.
fn preview(step: u64, photograph: &Arc<Image>) -> Preview {
    let render = Arc::new(flat(4, 3, (step * 16 % 256) as u8));
    Preview { render, photograph: Arc::clone(photograph) }
}

/// The file at a place of every fake curve; the first is [`FILE`].
pub fn curve_file(place: usize) -> Vec<u8> {
    [FILE, &b"!".repeat(place)].concat()
}

/// The figures of every fake job.
pub fn metrics() -> JobMetrics {
    let view = |name: &str, lpips| ViewScore { name: name.into(), psnr: 30.0, ssim: 0.9, lpips: Some(lpips) };
    let scores = Scores {
        psnr: Some(30.0),
        ssim: Some(0.9),
        lpips: Some(0.2),
        lpips_network: Some(LpipsNetwork::Vgg),
        views: 2,
        per_view: vec![view("test/r_0", 0.1), view("test/r_1", 0.3)],
    };
    JobMetrics {
        test: scores.clone(),
        train: scores,
        bytes: ByteCounts { total: FILE.len() as u64, container: FILE.len() as u64, ..ByteCounts::default() },
        seconds: PhaseSeconds::default(),
        steps: 10,
        steps_per_second: 5.0,
        view_pixels: Some(1280),
        anchors: 1,
        gaussians: 1,
        psnr_before_quantisation: Some(30.5),
        decode_sha256: Digest::of(b"decoded"),
        adapter: "fake".into(),
        background: Background::White,
        conventions: Conventions::new(Some(LpipsNetwork::Vgg)),
        byte_budget: None,
        convergence: None,
        coding: Some(CodingEfficiency { entropy_overhead: 1.001, over_floats: Some(1.002) }),
        stages: Some(CodingStages { views: 2, floats: 30.5, noise: 30.2, rounded: 30.25, decoded: 30.0 }),
        rendering: Some(RenderingError {
            views: 1,
            size: [32, 24],
            rmse: 1.5e-7,
            max: 2e-6,
            cutoff_rmse: 1e-4,
        }),
        frame: SceneFrame::around([5e5, 4e6, 10.0].into(), 6.0),
        color_fit: Some(ColorFitScores { views: 2, psnr: 29.5, corrected_psnr: 31.25 }),
        exposure: Some(ExposureChoice::by(ExposureTrial { views: 4, gain: 2.5, needed: 0.5 })),
        crop: Some(CropCost {
            region: Crop::Cameras,
            gaussians_removed: 7,
            saved_bytes: 1234,
            lost_psnr: Some(0.25),
        }),
        rd_curve: Vec::new(),
    }
}

/// The pictures of every fake job: one view, whose name is as hostile as a zip may make it.
pub fn held_out() -> HeldOut {
    let score = ViewScore { name: HOSTILE.into(), psnr: 30.0, ssim: 0.9, lpips: None };
    let picture = |color: &str| color.to_owned();
    HeldOut {
        of: 2,
        ceiling: 0.2,
        ramp: vec![[0, 0, 4], [252, 255, 164]],
        views: vec![HeldOutView {
            score,
            camera: cameras()[1].camera,
            width: 40,
            height: 32,
            photograph: picture("cGhvdG8="),
            render: picture("cmVuZGVy"),
            error: picture("ZXJyb3I="),
        }],
    }
}

/// A name that would be markup, an attribute's end and a script if it were not escaped.
pub const HOSTILE: &str = "\"'><script>alert(1)</script><img src=//evil.example/x onerror=alert(1)>&amp;";

/// The dataset cameras of every fake job: an off-center principal point and unequal focal lengths.
pub fn cameras() -> Vec<NamedCamera> {
    let camera = |x: f64| Camera {
        intrinsics: Intrinsics { fx: 50.0, fy: 55.0, cx: 21.0, cy: 15.5, width: 40, height: 32 },
        pose: Pose::look_at(DVec3::new(x, 1.0, 2.0), DVec3::ZERO, DVec3::Z).expect("a view"),
    };
    ["train/r_0", "test/r_0", "test/r_1"]
        .into_iter()
        .zip([2.0, 3.0, 4.0])
        .map(|(name, x)| NamedCamera {
            name: name.into(),
            split: if name.starts_with("train") { Split::Train } else { Split::Test },
            camera: camera(x),
        })
        .collect()
}

/// Paints a picture whose colors tell the camera apart (to six decimals). A width of 13 panics, 14 loses the device, 15
/// lacks memory, 17 waits at the gate; a height of 18 loses the device with every picture of it
/// but the first.
#[derive(Debug, Default, Clone)]
pub struct FakeRenderer {
    pub gate: Arc<Gate>,
    painted: Arc<AtomicUsize>,
    unlucky: Arc<AtomicUsize>,
}

impl FakeRenderer {
    /// Pictures painted so far.
    pub fn painted(&self) -> usize {
        self.painted.load(Ordering::SeqCst)
    }

    /// The digest of what is seen.
    fn paint(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Digest, Problem> {
        let place = (0..8).find(|place| artifact == Digest::of(&curve_file(*place))).expect("a known file");
        self.painted.fetch_add(1, Ordering::SeqCst);
        load()?;
        let Intrinsics { fx, fy, cx, cy, width, height } = camera.intrinsics;
        let lost = || Err(Problem::new(ProblemType::DeviceLost, "as the test wants it"));
        match (width, height) {
            (13, _) => panic!("as the test wants it"),
            (14, _) => return lost(),
            (15, _) => return Err(Problem::new(ProblemType::GpuMemory, "as the test wants it")),
            (17, _) => self.gate.pass(),
            (_, 18) if self.unlucky.fetch_add(1, Ordering::SeqCst) > 0 => return lost(),
            _ => {}
        }
        let rotation = camera.pose.rotation().to_cols_array();
        let numbers = rotation.into_iter().chain(camera.pose.center().to_array()).chain([fx, fy, cx, cy]);
        // Adding zero turns -0.0 into 0.0.
        let text: Vec<String> = numbers.map(|v| format!("{:.6}", (v * 1e6).round() / 1e6 + 0.0)).collect();
        Ok(Digest::of(format!("{}{}", text.join(","), "!".repeat(place)).as_bytes()))
    }
}

impl RenderViews for FakeRenderer {
    fn identity(&self) -> String {
        "paint".into()
    }

    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        let digest = self.paint(artifact, load, camera)?;
        let Intrinsics { width, height, .. } = camera.intrinsics;
        let samples = (0..width as usize * height as usize * 3).map(|i| digest.as_bytes()[i % 32]).collect();
        Ok(Image::new(width, height, 3, samples).expect("an image"))
    }

    fn render_scalars(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
        kind: ScalarKind,
    ) -> Result<ScalarImage, Problem> {
        let digest = self.paint(artifact, load, camera)?;
        let Intrinsics { width, height, .. } = camera.intrinsics;
        // Nothing in the first pixel, then what the camera decides.
        let level = |i: usize| if i == 0 { 0.0 } else { f32::from(digest.as_bytes()[i % 32]) / 255.0 };
        let most = if kind == ScalarKind::Depth { 8.0 } else { 1.0 };
        let values = (0..width as usize * height as usize).map(|i| most * level(i)).collect();
        Ok(ScalarImage { width, height, values })
    }
}

/// Accepts the files of fake jobs only.
pub fn load(file: &[u8]) -> Result<Viewable, Problem> {
    assert!(file.starts_with(FILE));
    Ok(Viewable { scene: Scene::Anchors(empty_scene()), background: Background::White })
}

/// Refuses a dataset that begins with `bad`, panics at `bomb`.
pub fn check(dataset: &Path) -> Result<DatasetSummary, Problem> {
    let content = fs::read(dataset).expect("the staged file is readable");
    assert!(!content.starts_with(b"bomb"), "as the test wants it");
    if content.starts_with(b"bad") {
        let error = "frame 3 has a focal length of 0; it must be a positive number of pixels";
        return Err(Problem::new(ProblemType::InvalidDataset, error).in_file("transforms.json"));
    }
    Ok(DatasetSummary {
        layout: Layout::Blender,
        train: 1,
        test: 2,
        pixels: 3 * 40 * 32,
        points: None,
        notes: vec!["as the test wants it".into()],
    })
}

/// A scene without anchors.
pub fn empty_scene() -> AnchorScene {
    let mlp = || Mlp { layers: Vec::new() };
    AnchorScene {
        lattice: Lattice { voxel: 1.0, origin: [0.0; 3] },
        cells: Vec::new(),
        feature_dim: 1,
        offsets_per_anchor: 1,
        features: Vec::new(),
        scalings: Vec::new(),
        offsets: Vec::new(),
        masks: Vec::new(),
        networks: RenderNetworks { opacity: mlp(), covariance: mlp(), color: mlp() },
        near: NearPlane::default(),
        scene_scale: SceneScale::default(),
        frame: SceneFrame::default(),
    }
}

/// Writes a line in place of an export, and counts how often. How alike it looks can be told of a `.ply` alone. A file of the second weight of a curve waits at the gate first, one
/// of the third cannot be exported; a placed export of one Gaussian waits there too.
#[derive(Debug, Default)]
pub struct FakeExporter {
    pub gate: Gate,
    pub made: std::sync::atomic::AtomicUsize,
}

/// Checks datasets.
pub type DatasetCheck = Arc<dyn Fn(&Path) -> Result<DatasetSummary, Problem> + Send + Sync>;

/// What a service is given.
pub struct FakeEngine {
    pub check: DatasetCheck,
    pub renderer: FakeRenderer,
    pub exporter: Arc<FakeExporter>,
}

impl Default for FakeEngine {
    fn default() -> Self {
        Self { check: Arc::new(check), renderer: FakeRenderer::default(), exporter: Arc::default() }
    }
}

impl SceneEngine for FakeEngine {
    fn check(&self, archive: &Path, reading: &ReadOptions) -> Result<DatasetSummary, Problem> {
        if !reading.skip_missing && fs::read(archive).is_ok_and(|content| content.starts_with(b"incomplete"))
        {
            let error = "1 of the 3 images listed here are missing: images/0.png";
            return Err(Problem::new(ProblemType::InvalidDataset, error).in_file("transforms.json"));
        }
        let has_astray_masks = || fs::read(archive).is_ok_and(|content| content.ends_with(b"astray masks"));
        if reading.masks != MaskSource::None && has_astray_masks() {
            let error = "no mask has the name of a photograph; train without masks (masks=none)";
            return Err(Problem::new(ProblemType::DatasetRejected, error));
        }
        (self.check)(archive)
    }

    fn needs(&self, summary: &DatasetSummary, options: &TrainOptions) -> JobNeeds {
        let unit = "anchors".to_owned();
        let memory = MemoryNeeds { gpu_bytes: summary.pixels, host_bytes: 2, max_size: 3, unit };
        let steps = u64::from(options.iterations.unwrap_or(2000));
        let file_bytes = ValueRange { low: 100, high: 200 };
        JobNeeds { steps, memory: Some(memory), file_bytes, notes: vec!["as the test wants it".into()] }
    }

    fn load(&self, file: &[u8]) -> Result<Viewable, Problem> {
        load(file)
    }

    fn renderer(&self, _: Digest) -> Result<Arc<dyn RenderViews>, Problem> {
        Ok(Arc::new(self.renderer.clone()))
    }

    fn export(
        &self,
        source: SceneSource<'_>,
        format: SceneFormat,
        cameras: &[NamedCamera],
    ) -> Result<ExportedScene, Problem> {
        let file = (source.read)()?;
        if file == curve_file(1) {
            self.exporter.gate.pass();
        }
        if file == curve_file(2) {
            let detail = "as the test wants it";
            return Err(Problem::new(ProblemType::NotExportable, detail));
        }
        assert!(file != curve_file(3), "as the test wants it");
        self.exporter.made.fetch_add(1, Ordering::SeqCst);
        let trained = cameras.iter().filter(|camera| camera.split == Split::Train).count();
        let text = format!("{} from {trained} cameras of {} bytes", format.name(), file.len());
        let fidelity = (format == SceneFormat::Ply).then_some(ExportFidelity { psnr: 41.256, views: 2 });
        Ok(ExportedScene { bytes: text.into_bytes(), gaussians: 5, sh_degree: 3, fidelity })
    }

    fn place(&self, ply: &[u8], export: &PlacedExport, cameras: &[Camera]) -> Result<Vec<u8>, Problem> {
        let PlacedExport { format, similarity, limit, .. } = export;
        if *limit == Some(1) {
            self.exporter.gate.pass();
        }
        let (ply, turn) =
            (String::from_utf8_lossy(ply), similarity.rotation().to_axis_angle().1.to_degrees());
        let scale = similarity.scale();
        let limited =
            limit.map_or_else(String::new, |limit| format!(" {limit} by {} cameras", cameras.len()));
        Ok(format!("{} turned by {turn:.0} times {scale}{limited} of {ply}", format.name()).into_bytes())
    }

    fn viewers(&self) -> Option<usize> {
        None
    }
}

/// One live worker, and the jobs that it was asked to forget.
#[derive(Debug, Default)]
pub struct FakeWorkers {
    pub forgotten: Mutex<Vec<JobId>>,
}

impl Workers for FakeWorkers {
    fn counts(&self) -> WorkerCounts {
        WorkerCounts { expected: 1, alive: 1 }
    }

    fn forget(&self, job: JobId) {
        self.forgotten.lock().expect("not poisoned").push(job);
    }
}
