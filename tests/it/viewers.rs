//! Views and exports by viewers, here servers of this process with renderers that tell who rendered what.

use std::{
    path::Path,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
};

use glam::DVec3;
use tcgs::{
    domain::{
        Background, Camera, Clock as _, DatasetSummary, Digest, ExportFidelity, ExportedScene, Image,
        Intrinsics, ManualClock, NamedCamera, Pose, Problem, ProblemType, ReadOptions, SceneFormat, Split,
        SystemRandom, ViewerToken,
    },
    engine::{SceneEngine, SceneSource},
    http::{self, HttpConfig, ViewerConfig, ViewerServices},
    render::{
        RenderViews,
        views::{ScalarImage, ScalarKind, Viewable},
    },
    store::{Blobs, QueuePolicy, Store, VIEWER_LIFE, ViewerRecord},
    viewers::{self, ViewerPool, protocol},
};
use tempfile::TempDir;
use tokio::{net::TcpListener, runtime::Handle, task::JoinHandle, task::spawn_blocking};
use tokio_util::sync::CancellationToken;

use crate::support::{eventually::within, fakes};

/// Renders one color that depends on the scene's file and on the identity, and notes which files it was asked for.
#[derive(Debug)]
struct Painter {
    identity: String,
    painted: Mutex<Vec<Digest>>,
    is_lost: AtomicBool,
    gate: fakes::Gate,
}

impl Painter {
    fn color(&self, artifact: Digest) -> u8 {
        Digest::of(format!("{artifact} by {}", self.identity).as_bytes()).as_bytes()[0]
    }

    fn paint(&self, artifact: Digest, load: &dyn Fn() -> Result<Viewable, Problem>) -> Result<u8, Problem> {
        self.painted.lock().expect("not poisoned").push(artifact);
        if self.is_lost.load(Ordering::SeqCst) {
            return Err(Problem::new(ProblemType::DeviceLost, "as the test wants it"));
        }
        load()?;
        Ok(self.color(artifact))
    }

    fn painted(&self) -> Vec<Digest> {
        self.painted.lock().expect("not poisoned").clone()
    }
}

/// Paints views, and makes files out of what it was given.
struct PainterEngine(Arc<Painter>);

impl SceneEngine for PainterEngine {
    fn check(&self, archive: &Path, _: &ReadOptions) -> Result<DatasetSummary, Problem> {
        fakes::check(archive)
    }

    fn load(&self, file: &[u8]) -> Result<Viewable, Problem> {
        assert!(file.starts_with(b"scene "), "the scene's own file");
        Ok(Viewable {
            scene: tcgs::domain::Scene::Anchors(fakes::empty_scene()),
            background: Background::White,
        })
    }

    fn renderer(&self, _: Digest) -> Result<Arc<dyn RenderViews>, Problem> {
        Ok(self.0.clone())
    }

    fn export(
        &self,
        source: SceneSource<'_>,
        format: SceneFormat,
        cameras: &[NamedCamera],
    ) -> Result<ExportedScene, Problem> {
        let file = (source.read)()?;
        let bytes = [format.name().as_bytes(), &file, cameras[0].name.as_bytes()].concat();
        let fidelity = Some(ExportFidelity { psnr: 0.1 + 0.2, views: 2 });
        Ok(ExportedScene { bytes, gaussians: 5, sh_degree: 3, fidelity })
    }

    fn viewers(&self) -> Option<usize> {
        None
    }
}

impl RenderViews for Painter {
    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn render(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
    ) -> Result<Image, Problem> {
        let Intrinsics { width, height, .. } = camera.intrinsics;
        if width == 17 {
            self.gate.pass();
        }
        let color = self.paint(artifact, load)?;
        Ok(Image::new(width, height, 4, vec![color; width as usize * height as usize * 4]).expect("an image"))
    }

    fn render_scalars(
        &self,
        artifact: Digest,
        load: &dyn Fn() -> Result<Viewable, Problem>,
        camera: &Camera,
        kind: ScalarKind,
    ) -> Result<ScalarImage, Problem> {
        let color = f32::from(self.paint(artifact, load)?);
        let value = if kind == ScalarKind::Depth { color + 0.1 } else { color / 255.0 };
        let Intrinsics { width, height, .. } = camera.intrinsics;
        Ok(ScalarImage { width, height, values: vec![value; width as usize * height as usize] })
    }
}

/// A viewer that runs in this process.
struct Machine {
    painter: Arc<Painter>,
    record: ViewerRecord,
    shutdown: CancellationToken,
    serving: JoinHandle<()>,
}

impl Machine {
    /// Ends it as if its machine had gone: it is still announced.
    async fn stop(self) -> ViewerRecord {
        self.shutdown.cancel();
        self.serving.await.expect("it ends");
        self.record
    }
}

/// A database and blobs, and the replica's pool over them.
struct Fixture {
    store: Store,
    blobs: Blobs,
    clock: Arc<ManualClock>,
    pool: Arc<ViewerPool>,
    _data: TempDir,
}

impl Fixture {
    async fn new() -> Self {
        let data = tempfile::tempdir().expect("a folder");
        let clock = Arc::new(ManualClock::new("2026-11-24T12:00:00Z".parse().expect("an instant")));
        let store = Store::open(&data.path().join("tcgs.db"), clock.clone(), QueuePolicy::default()).await;
        let store = store.expect("a database");
        let blobs = Blobs::open(data.path()).expect("a blob store");
        let pool = ViewerPool::new(store.clone(), clock.clone(), Handle::current()).expect("a client");
        Self { store, blobs, clock, pool: Arc::new(pool), _data: data }
    }

    /// Starts a viewer with this identity and announces it.
    async fn machine(&self, identity: &str, limits: ViewerConfig) -> Machine {
        let painter = Arc::new(Painter {
            identity: identity.into(),
            painted: Mutex::default(),
            is_lost: AtomicBool::new(false),
            gate: fakes::Gate::default(),
        });
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let record = ViewerRecord {
            url: format!("http://{}", listener.local_addr().expect("bound")),
            version: env!("CARGO_PKG_VERSION").into(),
            identity: identity.into(),
            token: ViewerToken::generate(&SystemRandom).expect("randomness"),
        };
        let services = ViewerServices {
            blobs: self.blobs.clone(),
            engine: Arc::new(PainterEngine(painter.clone())),
            token: record.token.clone(),
        };
        let shutdown = CancellationToken::new();
        let config = HttpConfig { drain: std::time::Duration::from_millis(100), ..HttpConfig::default() };
        let serving = tokio::spawn(http::serve_viewer(listener, config, limits, services, shutdown.clone()));
        self.store.announce_viewer(&record).await.expect("announced");
        self.pool.refresh().await;
        Machine { painter, record, shutdown, serving }
    }

    /// Publishes a scene's file.
    async fn scene(&self, number: u32) -> Digest {
        self.blobs.put(format!("scene {number}").into()).await.expect("published").digest
    }

    /// A picture by the viewers; its first byte.
    async fn picture(&self, artifact: Digest) -> Result<u8, Problem> {
        self.request_picture(artifact).await.expect("no panic")
    }

    /// Asks for a picture.
    fn request_picture(&self, artifact: Digest) -> JoinHandle<Result<u8, Problem>> {
        let pool = Arc::clone(&self.pool);
        spawn_blocking(move || {
            let image = viewers::renderer(&pool, artifact)?.render(artifact, &unread, &camera(5))?;
            assert_eq!((image.width(), image.height(), image.channels()), (5, 3, 4));
            Ok(image.samples()[0])
        })
    }

    /// Lets time pass in which only this viewer is announced.
    async fn pass(&self, time: std::time::Duration, announced: &Machine) {
        self.clock.advance(time.try_into().expect("in range"));
        self.store.announce_viewer(&announced.record).await.expect("announced");
        self.pool.refresh().await;
    }
}

fn unread() -> Result<Viewable, Problem> {
    panic!("a replica does not read the scene")
}

fn camera(width: u32) -> Camera {
    let intrinsics = Intrinsics { fx: 5.0, fy: 5.5, cx: 2.1, cy: 1.5, width, height: 3 };
    let pose = Pose::look_at(DVec3::new(2.0, 1.0, 2.0), DVec3::ZERO, DVec3::Z).expect("a view");
    Camera { intrinsics, pose }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_renders_and_exports_what_its_renderer_and_exporter_make() {
    let fixture = Fixture::new().await;
    let viewer = fixture.machine("one", ViewerConfig::default()).await;
    let artifact = fixture.scene(1).await;
    let color = viewer.painter.color(artifact);
    assert_eq!(fixture.picture(artifact).await, Ok(color));

    let pool = Arc::clone(&fixture.pool);
    let ended = spawn_blocking(move || {
        let renderer = viewers::renderer(&pool, artifact).expect("a viewer");
        assert_eq!(renderer.identity(), "one");
        let plane = |kind| renderer.render_scalars(artifact, &unread, &camera(5), kind).expect("a plane");
        assert_eq!(plane(ScalarKind::Depth).values, vec![f32::from(color) + 0.1; 15]);
        assert_eq!(plane(ScalarKind::Alpha).values, vec![f32::from(color) / 255.0; 15]);
        let cameras = [NamedCamera { name: "r_0".into(), split: Split::Train, camera: camera(5) }];
        let exported = viewers::export(&pool, artifact, SceneFormat::Ply, &cameras).expect("an export");
        let fidelity = Some(ExportFidelity { psnr: 0.1 + 0.2, views: 2 });
        let bytes = b"plyscene 1r_0".to_vec();
        assert_eq!(exported, ExportedScene { bytes, gaussians: 5, sh_degree: 3, fidelity });
        // A file that is not there is the service's own fault, told as it is.
        let lost = renderer.render(Digest::of(b"lost"), &unread, &camera(5)).expect_err("no such file");
        assert!(lost.is(ProblemType::Internal), "{lost}");
    });
    ended.await.expect("no panic");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_who_has_the_token_is_answered() {
    let fixture = Fixture::new().await;
    let viewer = fixture.machine("one", ViewerConfig::default()).await;
    let artifact = fixture.scene(1).await;
    let channels = protocol::Channels::Color;
    let request = protocol::RenderRequest { artifact, camera: camera(5), channels };
    let message = protocol::write(&request, &[]).expect("it fits");
    let client = tcgs::https::client_builder().expect("TLS").build().expect("a client");
    let send = |path: &str, token: Option<&str>, message: &[u8]| {
        let request = client.post(format!("{}{path}", viewer.record.url)).body(message.to_vec());
        let request = match token {
            Some(token) => request.bearer_auth(token),
            None => request,
        };
        async move { request.send().await.expect("an answer").status().as_u16() }
    };
    let right = viewer.record.token.expose();
    for path in [protocol::RENDER, protocol::EXPORT] {
        for wrong in [None, Some(""), Some(&right[1..])] {
            assert_eq!(send(path, wrong, &message).await, 401, "{path} {wrong:?}");
        }
    }
    assert_eq!(viewer.painter.painted(), []);
    assert_eq!(send(protocol::RENDER, Some(right), &message[..message.len() - 1]).await, 422, "cut short");
    let mut impossible = request;
    impossible.camera.intrinsics.width = u32::MAX;
    let impossible = protocol::write(&impossible, &[]).expect("it fits");
    assert_eq!(send(protocol::RENDER, Some(right), &impossible).await, 422);
    let long = vec![0; protocol::MAX_RENDER_REQUEST + 1];
    assert_eq!(send(protocol::RENDER, Some(right), &long).await, 413);
    assert_eq!(viewer.painter.painted(), []);
    assert_eq!(send(protocol::RENDER, Some(right), &message).await, 200);
    let health = client.get(format!("{}/healthz", viewer.record.url)).send().await.expect("an answer");
    assert_eq!(health.status().as_u16(), 200);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_scene_stays_with_its_viewer_and_moves_to_another_with_the_same_bits_when_that_is_gone() {
    let fixture = Fixture::new().await;
    let one = fixture.machine("same", ViewerConfig::default()).await;
    let other = fixture.machine("same", ViewerConfig::default()).await;
    let mut scenes = Vec::new();
    for number in 0..16 {
        scenes.push(fixture.scene(number).await);
    }
    for _ in 0..2 {
        for scene in &scenes {
            assert_eq!(fixture.picture(*scene).await, Ok(one.painter.color(*scene)));
        }
    }
    let (of_one, of_other) = (one.painter.painted(), other.painter.painted());
    assert_eq!(of_one.len() + of_other.len(), 32);
    assert!(of_one.iter().all(|scene| !of_other.contains(scene)), "each is rendered by one of them");
    assert!(!of_one.is_empty() && !of_other.is_empty(), "and both have some");

    let moved = of_one[0];
    let gone = one.stop().await;
    assert_eq!(fixture.picture(moved).await, Ok(other.painter.color(moved)), "at once");
    assert_eq!(fixture.picture(of_other[0]).await, Ok(other.painter.color(of_other[0])));
    fixture.store.withdraw_viewer(&gone).await.expect("withdrawn");
    fixture.pool.refresh().await;
    assert_eq!(fixture.picture(moved).await, Ok(other.painter.color(moved)));
    let rest = other.stop().await;
    let none = fixture.picture(moved).await.expect_err("nobody");
    assert!(none.is(ProblemType::NoViewer) && none.status == 503, "{none}");
    fixture.store.withdraw_viewer(&rest).await.expect("withdrawn");
    fixture.pool.refresh().await;
    assert!(fixture.picture(moved).await.expect_err("nobody").is(ProblemType::NoViewer));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_with_other_bits_stands_in_only_for_a_request_that_begins_anew() {
    let fixture = Fixture::new().await;
    let first = fixture.machine("one adapter", ViewerConfig::default()).await;
    let second = fixture.machine("another adapter", ViewerConfig::default()).await;
    let artifact = fixture.scene(1).await;
    let begun = viewers::renderer(&fixture.pool, artifact).expect("a viewer");
    let (chosen, rest) = if begun.identity() == "one adapter" { (first, second) } else { (second, first) };
    chosen.painter.is_lost.store(true, Ordering::SeqCst);
    let lost = spawn_blocking(move || begun.render(artifact, &unread, &camera(5)));
    let lost = lost.await.expect("no panic").expect_err("its entity tag would be wrong");
    assert!(lost.is(ProblemType::DeviceLost), "{lost}");
    assert_eq!(rest.painter.painted(), []);
    assert_eq!(fixture.picture(artifact).await, Ok(rest.painter.color(artifact)), "with its own tag");

    // After a while the first is asked again.
    chosen.painter.is_lost.store(false, Ordering::SeqCst);
    fixture.clock.advance(jiff::SignedDuration::from_secs(11));
    assert_eq!(fixture.picture(artifact).await, Ok(chosen.painter.color(artifact)));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_of_another_version_is_not_asked_and_a_full_one_says_so() {
    let fixture = Fixture::new().await;
    let limits = ViewerConfig { renders_waiting: 0, ..ViewerConfig::default() };
    let viewer = fixture.machine("one", limits).await;
    let newer =
        ViewerRecord { url: "http://127.0.0.1:9".into(), version: "9.9.9".into(), ..viewer.record.clone() };
    fixture.store.announce_viewer(&newer).await.expect("announced");
    fixture.pool.refresh().await;
    assert_eq!(fixture.pool.len(), 1);

    let artifact = fixture.scene(1).await;
    let renderer = viewers::renderer(&fixture.pool, artifact).expect("a viewer");
    let busy = spawn_blocking(move || renderer.render(artifact, &unread, &camera(17)));
    let gate = Arc::clone(&viewer.painter);
    gate.gate.someone_waits().await;
    let full = fixture.picture(artifact).await.expect_err("it renders another");
    assert!(full.is(ProblemType::Busy) && full.status == 503, "{full}");
    gate.gate.open();
    assert!(busy.await.expect("no panic").is_ok());
    assert_eq!(fixture.picture(artifact).await, Ok(viewer.painter.color(artifact)));
    assert!(fixture.clock.elapsed().is_zero(), "a full viewer is not avoided afterwards");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_viewer_that_hangs_is_given_up_after_it_has_left_the_list() {
    let fixture = Fixture::new().await;
    let other = fixture.machine("same", ViewerConfig::default()).await;
    // It takes connections and never answers, as a process that is stopped does.
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("bound"));
    let token = ViewerToken::generate(&SystemRandom).expect("randomness");
    let hanging = ViewerRecord { url, token, ..other.record.clone() };
    fixture.store.announce_viewer(&hanging).await.expect("announced");
    fixture.pool.refresh().await;
    let mut number = 0;
    let (artifact, mut asked, _connection) = loop {
        let artifact = fixture.scene(number).await;
        let mut asked = fixture.request_picture(artifact);
        tokio::select! {
            accepted = listener.accept() => break (artifact, asked, accepted.expect("a connection")),
            color = &mut asked => assert_eq!(color.expect("no panic"), Ok(other.painter.color(artifact))),
        }
        number += 1;
    };

    fixture.pass(VIEWER_LIFE + std::time::Duration::from_secs(1), &other).await;
    assert_eq!(fixture.pool.len(), 1);
    assert_eq!(
        within("a later picture", fixture.picture(artifact)).await,
        Ok(other.painter.color(artifact)),
        "new requests do not ask it"
    );
    let early = tokio::time::timeout(std::time::Duration::from_millis(300), &mut asked).await;
    assert!(early.is_err(), "it may be finishing its requests");
    fixture.pass(std::time::Duration::from_secs(20), &other).await;
    let color = within("another viewer's answer", asked).await.expect("no panic");
    assert_eq!(color, Ok(other.painter.color(artifact)));
}
