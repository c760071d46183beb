//! A service's data, in SQLite and a folder or in PostgreSQL and a bucket: processes over it, and what is left of it afterwards.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
    sync::Arc,
};

use futures_util::TryStreamExt as _;
use jiff::SignedDuration;
use object_store::ObjectStore;
use serde_json::{Value, json};
use tcgs::{
    domain::{Clock as _, SystemClock},
    store::{
        Blobs, BucketUrl, DatabaseLocation, QueuePolicy, Store,
        garbage::{Collected, GarbagePolicy, collect},
    },
};
use tempfile::TempDir;

use super::{
    bucket::{self, S3Server},
    database::Database,
    eventually::eventually,
    gate::{Gate, Upstream},
    postgres::Cluster,
    program,
    service::Service,
    totals::totals_equal_a_recount,
};

/// Every blob that something refers to.
const REFERENCES: &str = "SELECT dataset FROM jobs UNION SELECT dataset FROM scenes
    UNION SELECT digest FROM artifacts UNION SELECT digest FROM exports";

/// Where a service keeps its data.
pub struct Deployment {
    pub database: Database,
    bucket: Option<(BucketUrl, Arc<dyn ObjectStore>)>,
    /// Variables of its processes.
    variables: Vec<(String, String)>,
    folder: TempDir,
}

impl Deployment {
    /// SQLite and a folder.
    pub fn local() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let database = Database::DataFolder(folder.path().to_owned());
        Self { database, bucket: None, variables: Vec::new(), folder }
    }

    /// PostgreSQL and a bucket. `None` where one of them is not installed; then the test is skipped.
    pub async fn shared() -> Option<Self> {
        let (cluster, server) = (Cluster::shared()?, S3Server::shared()?);
        let database = cluster.empty_database().await;
        let bucket = server.prefix();
        let mut variables = server.variables();
        variables.push(("TCGS_DATABASE".into(), database.url().expose().to_owned()));
        variables.push(("TCGS_BLOBS".into(), bucket.to_string()));
        let objects = server.connect(&bucket);
        let folder = tempfile::tempdir().expect("a folder");
        Some(Self {
            database: Database::Postgres(database),
            bucket: Some((bucket, objects)),
            variables,
            folder,
        })
    }

    /// The same through proxies before the database and the bucket, which change what they do with every connection now.
    pub async fn behind_gates(mut self) -> (Self, [Gate; 2]) {
        let Database::Postgres(database) = &self.database else { panic!("SQLite has no server") };
        let server = S3Server::shared().expect("asked before").address;
        let gates = [Gate::start(Upstream::Unix(database.socket())).await, Gate::start(server).await];
        let url = database.url_at(gates[0].address).expose().to_owned();
        let bucket = bucket::variables(gates[1].address);
        // Later variables take the place of earlier ones.
        self.variables.extend(bucket);
        self.variables.push(("TCGS_DATABASE".into(), url));
        (self, gates)
    }

    /// Sets a variable of all processes.
    #[must_use]
    pub fn with(mut self, name: &str, value: impl Into<String>) -> Self {
        self.variables.push((name.into(), value.into()));
        self
    }

    /// Leaves a variable out.
    #[must_use]
    pub fn without(mut self, name: &str) -> Self {
        self.variables.retain(|(other, _)| other != name);
        self
    }

    pub fn data(&self) -> &Path {
        self.folder.path()
    }

    pub fn has_bucket(&self) -> bool {
        self.bucket.is_some()
    }

    /// Starts a service with `workers` workers.
    pub async fn start(&self, workers: usize) -> Service {
        let environment: Vec<_> =
            self.variables.iter().map(|(name, value)| (&**name, value.clone())).collect();
        Service::start_in(self.data(), ["--workers", &workers.to_string()], &environment).await
    }

    /// The artifacts of every job that has some, by kind and place.
    pub async fn artifacts(&self) -> BTreeMap<String, BTreeMap<String, String>> {
        let rows = "SELECT job_id, kind || '/' || place, digest FROM artifacts";
        let mut jobs: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
        for row in self.database.rows(rows, 3).await {
            let [job, place, digest] = <[String; 3]>::try_from(row).expect("three columns");
            jobs.entry(job).or_default().insert(place, digest);
        }
        jobs
    }

    /// Collects all garbage, however young, as a service without clients would in the end.
    pub async fn collect(&self) -> Collected {
        let location = match &self.database {
            Database::Postgres(database) => DatabaseLocation::Postgres(database.url()),
            other => other.location(),
        };
        let store = Store::open_current(location, Arc::new(SystemClock), QueuePolicy::default());
        let store = store.await.expect("a database");
        let blobs = match &self.bucket {
            None => Blobs::open(self.data()).expect("a blob store"),
            Some((_, objects)) => {
                Blobs::open_bucket(self.data(), objects.clone(), store.clone()).await.expect("its bucket")
            }
        };
        let policy = GarbagePolicy { blob_grace: SignedDuration::ZERO, ..GarbagePolicy::default() };
        let collected = collect(&store, &blobs, &policy, SystemClock.now()).await.expect("collected");
        store.close().await;
        collected
    }

    /// Names of all files below a folder of the data, or of the bucket.
    async fn files(&self, folder: &str) -> BTreeSet<String> {
        let Some((_, objects)) = &self.bucket else {
            let mut files = BTreeSet::new();
            let mut folders = vec![self.data().join(folder)];
            while let Some(folder) = folders.pop() {
                for entry in fs::read_dir(folder).into_iter().flatten() {
                    let entry = entry.expect("an entry");
                    if entry.file_type().expect("a kind").is_dir() {
                        folders.push(entry.path());
                    } else {
                        files.insert(entry.file_name().to_string_lossy().into_owned());
                    }
                }
            }
            return files;
        };
        let prefix = object_store::path::Path::from(folder);
        let found: Vec<_> = objects.list(Some(&prefix)).try_collect().await.expect("a list");
        let name = |object: &object_store::ObjectMeta| object.location.filename().map(str::to_owned);
        found.iter().filter_map(name).collect()
    }

    /// Names of all blobs that are stored.
    pub async fn stored(&self) -> BTreeSet<String> {
        self.files(if self.has_bucket() { "sha256" } else { "blobs" }).await
    }

    /// Waits until an idle worker has removed the checkpoints of all jobs.
    pub async fn checkpoints_are_gone(&self) {
        let gone = async || {
            let local = fs::read_dir(self.data().join("checkpoints")).map_or(0, Iterator::count);
            local == 0 && self.files("checkpoints").await.is_empty()
        };
        eventually("the checkpoints of finished jobs are removed", gone).await;
    }

    /// After all processes have ended: collects garbage, and holds what is left to what is referred to. Returns what was collected.
    pub async fn assert_tidy(&self, after: &str) -> Collected {
        let collected = self.collect().await;
        let referred: BTreeSet<String> =
            self.database.rows(REFERENCES, 1).await.into_iter().flatten().collect();
        assert_eq!(self.stored().await, referred, "blobs after {after}");
        let known: BTreeSet<String> =
            self.database.rows("SELECT digest FROM blobs", 1).await.into_iter().flatten().collect();
        assert_eq!(known, referred, "rows of blobs after {after}");
        for folder in ["uploads", "checkpoints"] {
            assert_eq!(self.files(folder).await, BTreeSet::new(), "{folder} after {after}");
        }
        let local = |folder: &str| fs::read_dir(self.data().join(folder)).map_or(0, Iterator::count);
        assert_eq!((local("staging"), local("checkpoints")), (0, 0), "private files after {after}");
        let found = self.fsck();
        assert_eq!(found["content_checked"], true);
        for what in ["missing", "damaged", "orphans", "database"] {
            assert_eq!(found[what], json!([]), "{what} after {after}");
        }
        totals_equal_a_recount(&self.database, after).await;
        collected
    }

    /// What `tcgs fsck` finds.
    fn fsck(&self) -> Value {
        let mut command = program::command();
        command.args(["fsck", "--json", "--data"]).arg(self.data());
        command.envs(self.variables.iter().map(|(name, value)| (name, value)));
        let output = command.output().expect("the binary runs");
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)))
    }
}
