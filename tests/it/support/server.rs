//! The whole service on a real socket, with fake training and rendering.

use std::{net::SocketAddr, num::NonZeroU32, path::PathBuf, sync::Arc, time::Duration};

use bytes::Bytes;
use object_store::ObjectStore;
use reqwest::{RequestBuilder, header::HeaderMap};
use serde_json::Value;
use tcgs::{
    domain::{Clock, DatasetId, KeyId, ProjectId, ProjectLimits, Scope, SystemClock, SystemRandom},
    http::{self, HttpConfig, Services, config::RequestLimits},
    store::{
        Blobs, DATABASE, DatabaseLocation, DatasetRecord, KeyProject, KeyRequest, NewKey, QueuePolicy, Store,
    },
    worker::{self, WorkerConfig},
};
use tempfile::TempDir;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::{
    contract::Coverage,
    eventually::{PATIENCE, eventually},
    fakes::{self, DatasetCheck, FakeEngine, FakeExporter, FakeRenderer, FakeRunner, FakeWorkers},
    faults::PlannedFaults,
    sse::Reader,
};

/// How a test's server differs from the usual one.
pub struct Setup {
    pub limits: RequestLimits,
    pub header_timeout: Duration,
    pub max_connections: usize,
    pub worker: bool,
    pub policy: QueuePolicy,
    /// Whatever else is to be otherwise.
    pub tune: fn(&mut HttpConfig),
    pub clock: Arc<dyn Clock>,
    /// The database's clock, if it is another.
    pub database_clock: Option<Arc<dyn Clock>>,
    /// How datasets are checked.
    pub check: DatasetCheck,
    /// The database, if not SQLite in the server's folder.
    pub database: Option<DatabaseLocation>,
    /// Where blobs are, if not in the server's folder.
    pub bucket: Option<Arc<dyn ObjectStore>>,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            limits: RequestLimits {
                upload_bytes: 1 << 20,
                min_free_space: 1,
                watch_interval: Duration::from_millis(5),
                deadline_check_interval: Duration::from_millis(5),
                ..RequestLimits::default()
            },
            header_timeout: Duration::from_secs(10),
            max_connections: 512,
            worker: true,
            policy: quick_policy(),
            tune: |_| {},
            clock: Arc::new(SystemClock),
            database_clock: None,
            check: Arc::new(fakes::check),
            database: None,
            bucket: None,
        }
    }
}

/// The usual policy, but the next attempt begins at once.
pub fn quick_policy() -> QueuePolicy {
    QueuePolicy {
        backoff_base: Duration::ZERO,
        hold_delay: Duration::ZERO,
        progress_event_every: Duration::ZERO,
        ..QueuePolicy::default()
    }
}

/// A worker that does everything quickly.
pub fn quick_worker(id: &str) -> WorkerConfig {
    WorkerConfig {
        poll: Duration::from_millis(5),
        heartbeat: Duration::from_millis(20),
        report_every: Duration::from_millis(5),
        ..WorkerConfig::new(id)
    }
}

/// A running service and a client that holds every answer to the contract.
pub struct Server {
    pub address: SocketAddr,
    /// The metrics' own address, if they have one.
    pub metrics_address: Option<SocketAddr>,
    pub store: Store,
    /// How calls of the store fail.
    pub faults: Arc<PlannedFaults>,
    pub services: Services,
    pub runner: FakeRunner,
    pub renderer: FakeRenderer,
    pub exporter: Arc<FakeExporter>,
    pub shutdown: CancellationToken,
    pub serving: JoinHandle<()>,
    pub coverage: Coverage,
    client: reqwest::Client,
    /// The folder of database and blobs, for another server to go on with.
    pub data: Arc<TempDir>,
}

/// A key of a test.
#[derive(Debug, Clone)]
pub struct TestKey {
    pub id: KeyId,
    pub project: ProjectId,
    pub key: String,
}

/// Reads a picture.
pub fn picture(file: &[u8]) -> image::DynamicImage {
    let reader = image::ImageReader::new(std::io::Cursor::new(file)).with_guessed_format();
    reader.expect("in memory").decode().expect("a picture")
}

/// A checked answer.
#[derive(Debug, Clone)]
pub struct Answer {
    pub status: u16,
    pub headers: HeaderMap,
    pub body: Bytes,
}

impl Answer {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("a JSON body")
    }

    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).unwrap_or_else(|| panic!("no {name}")).to_str().expect("ASCII")
    }

    /// Whether the service could not reach its database in time.
    fn is_of_a_busy_database(&self) -> bool {
        // The answer to HEAD has no body.
        let problem: Value = serde_json::from_slice(&self.body).unwrap_or_default();
        self.status == 503 && problem["detail"] == "the database is busy"
    }

    /// Asserts the status and shows the body if it is another.
    #[track_caller]
    pub fn expect(self, status: u16) -> Self {
        assert_eq!(self.status, status, "{}", String::from_utf8_lossy(&self.body));
        self
    }

    /// Asserts a problem of one type and returns its detail.
    #[track_caller]
    pub fn expect_problem(self, status: u16, kind: &str) -> String {
        let problem = self.expect(status).json();
        assert_eq!(problem["type"], format!("urn:tcgs:problem:{kind}"), "{problem:#}");
        problem["detail"].as_str().expect("a detail").to_owned()
    }
}

impl Server {
    pub async fn start(coverage: &Coverage) -> Self {
        Self::start_with(coverage, Setup::default()).await
    }

    pub async fn start_with(coverage: &Coverage, setup: Setup) -> Self {
        Self::start_in(coverage, setup, Arc::new(tempfile::tempdir().expect("a folder"))).await
    }

    /// Starts over what an earlier server left in its folder.
    pub async fn start_in(coverage: &Coverage, setup: Setup, data: Arc<TempDir>) -> Self {
        let clock = setup.clock;
        let database = setup.database.unwrap_or_else(|| (&data.path().join(DATABASE)).into());
        let database_clock = setup.database_clock.unwrap_or_else(|| Arc::clone(&clock));
        let store = Store::open(database, database_clock, setup.policy).await.expect("a database");
        let blobs = match setup.bucket {
            Some(bucket) => Blobs::open_bucket(data.path(), bucket, store.clone()).await,
            None => Blobs::open(data.path()),
        };
        let blobs = blobs.expect("a blob store");
        let faults = Arc::new(PlannedFaults::default());
        let store = store.with_faults(faults.clone());
        let (runner, renderer) = (FakeRunner::default(), FakeRenderer::default());
        let exporter = Arc::new(FakeExporter::default());
        let services = Services {
            store: store.clone(),
            blobs: blobs.clone(),
            clock,
            entropy: Arc::new(SystemRandom),
            engine: Arc::new(FakeEngine {
                check: setup.check,
                renderer: renderer.clone(),
                exporter: Arc::clone(&exporter),
            }),
            workers: Arc::new(FakeWorkers::default()),
        };
        let shutdown = CancellationToken::new();
        if setup.worker {
            let worker = worker::serve(
                store.clone(),
                blobs,
                Arc::new(runner.clone()),
                quick_worker("test"),
                shutdown.clone(),
            );
            tokio::spawn(worker);
        }
        let mut config = HttpConfig {
            listen: "127.0.0.1:0".parse().expect("an address"),
            header_timeout: setup.header_timeout,
            max_connections: setup.max_connections,
            limits: setup.limits,
            ..HttpConfig::default()
        };
        (setup.tune)(&mut config);
        let listener = http::bind(&config, false).await.expect("a port");
        let address = listener.address().expect("bound");
        let metrics_address = listener.metrics_address().expect("bound");
        let serving = tokio::spawn(http::serve(listener, config, services.clone(), shutdown.clone()));
        let client = tcgs::https::client_builder()
            .expect("TLS")
            .timeout(Duration::from_secs(60))
            .build()
            .expect("a client");
        let coverage = coverage.clone();
        Self {
            address,
            metrics_address,
            store,
            faults,
            services,
            runner,
            renderer,
            exporter,
            shutdown,
            serving,
            coverage,
            client,
            data,
        }
    }

    /// A key with these scopes.
    pub async fn key(&self, scopes: &[Scope]) -> TestKey {
        self.key_with(scopes, ProjectLimits::default()).await
    }

    /// The same with limits of its project.
    pub async fn key_with(&self, scopes: &[Scope], limits: ProjectLimits) -> TestKey {
        self.draw_key(KeyRequest { scopes, project: KeyProject::New(limits), ..KeyRequest::default() }).await
    }

    /// A key with these scopes that may send so many requests per minute.
    pub async fn key_at_rate(&self, scopes: &[Scope], rate: NonZeroU32) -> TestKey {
        self.draw_key(KeyRequest { scopes, requests_per_minute: Some(rate), ..KeyRequest::default() }).await
    }

    /// Another key of the same project.
    pub async fn key_beside(&self, key: &TestKey, scopes: &[Scope]) -> TestKey {
        let project = KeyProject::Existing(key.project);
        self.draw_key(KeyRequest { scopes, project, ..KeyRequest::default() }).await
    }

    async fn draw_key(&self, request: KeyRequest<'_>) -> TestKey {
        let request = KeyRequest { name: "a test's", ..request };
        let drawn = NewKey::generate(&SystemRandom, self.services.clock.now(), request);
        let (new, key) = drawn.expect("a key");
        let record = self.store.create_key(new).await.expect("stored");
        TestKey { id: record.id, project: record.project_id, key: key.expose().to_owned() }
    }

    /// Shuts a key out.
    pub async fn revoke(&self, key: &TestKey) {
        self.store.revoke_key(key.id).await.expect("a store").expect("a key");
    }

    /// A scene as it is stored.
    pub async fn store_scene(&self, id: Uuid) -> DatasetRecord {
        self.services.store.dataset(DatasetId(id)).await.expect("read").expect("known")
    }

    /// Sends a request and checks the answer against the contract. A database that is busy without a planned fault, because the machine
    /// is, is asked again, as clients do.
    pub async fn send(
        &self,
        method: &str,
        path: &str,
        fill: impl FnOnce(RequestBuilder) -> RequestBuilder,
    ) -> Answer {
        let method = method.parse().expect("a method");
        let url = format!("http://{}{path}", self.address);
        let mut request =
            fill(self.client.request(reqwest::Method::clone(&method), url)).build().expect("a request");
        let end = tokio::time::Instant::now() + PATIENCE;
        loop {
            let again = request.try_clone();
            let response = self.client.execute(request).await.expect("an answer");
            let (status, headers) = (response.status().as_u16(), response.headers().clone());
            let body = response.bytes().await.expect("a whole body");
            self.coverage.check(method.as_str(), path, status, &headers, &body);
            let answer = Answer { status, headers, body };
            match again {
                Some(again)
                    if answer.is_of_a_busy_database()
                        && !self.faults.is_failing()
                        && tokio::time::Instant::now() < end =>
                {
                    request = again;
                }
                _ => return answer,
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    }

    /// Opens a stream of events, after the one seen last.
    pub async fn stream(&self, path: &str, seen: Option<u64>) -> Reader {
        let request = self.client.get(format!("http://{}{path}", self.address));
        let request = request.header("accept", "text/event-stream");
        let request = seen.into_iter().fold(request, |request, seen| request.header("last-event-id", seen));
        Reader::new(request.send().await.expect("an answer"))
    }

    /// Where the database is.
    pub fn database(&self) -> PathBuf {
        self.data.path().join(DATABASE)
    }

    /// Sends a request and hands over the answer, whose body is still to come.
    pub async fn open(
        &self,
        method: &str,
        path: &str,
        fill: impl FnOnce(RequestBuilder) -> RequestBuilder,
    ) -> reqwest::Response {
        let url = format!("http://{}{path}", self.address);
        let request = self.client.request(method.parse().expect("a method"), url);
        fill(request).send().await.expect("an answer")
    }

    /// Sends a request whose answer may break off; its status, and what of its body came.
    pub async fn broken(
        &self,
        method: &str,
        path: &str,
        fill: impl FnOnce(RequestBuilder) -> RequestBuilder,
    ) -> (u16, Vec<u8>) {
        let mut open = self.open(method, path, fill).await;
        let mut body = Vec::new();
        while let Ok(Some(chunk)) = open.chunk().await {
            body.extend_from_slice(&chunk);
        }
        (open.status().as_u16(), body)
    }

    pub async fn get(&self, path: &str) -> Answer {
        self.send("GET", path, |request| request).await
    }

    /// Asks until the service is ready: what was found last is told again for a while.
    pub async fn until_ready(&self) {
        for _ in 0..600 {
            if self.get("/readyz").await.status == 200 {
                return;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        panic!("the service did not become ready");
    }

    pub async fn post(&self, path: &str) -> Answer {
        self.send("POST", path, |request| request).await
    }

    pub async fn post_json(&self, path: &str, body: &Value) -> Answer {
        self.send("POST", path, |request| request.json(body)).await
    }

    /// `POST /v1/jobs` with a query and a dataset.
    pub async fn upload(&self, query: &str, dataset: &str) -> Answer {
        self.send("POST", &format!("/v1/jobs{query}"), |request| {
            request.header("content-type", "application/zip").body(dataset.to_owned())
        })
        .await
    }

    /// Creates a job and returns its path.
    pub async fn create(&self, dataset: &str) -> String {
        self.upload("", dataset).await.expect(201).header("location").to_owned()
    }

    /// Asks for a job until it is in `state`.
    pub async fn reaches(&self, job: &str, state: &str) -> Value {
        let mut now = Value::Null;
        eventually(&format!("{job} is {state}"), async || {
            now = self.get(job).await.expect(200).json();
            let is_there = now["state"] == state;
            let waits = now["finished_at"].is_null();
            assert!(is_there || waits, "the job can no longer become {state}: {now:#}");
            is_there
        })
        .await;
        now
    }

    /// Creates a job and waits until it has succeeded.
    pub async fn succeeded(&self) -> String {
        let job = self.create("succeed").await;
        self.reaches(&job, "succeeded").await;
        job
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.runner.gate.open();
        self.renderer.gate.open();
        self.exporter.gate.open();
        self.shutdown.cancel();
    }
}
