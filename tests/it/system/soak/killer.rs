//! Kills services and workers at random moments, and starts services again.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    fs,
    process::Command,
    sync::{Arc, Mutex},
    time::Duration,
};

use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;
use tokio::time::{Instant, sleep, timeout};

use crate::support::{deployment::Deployment, eventually::eventually, service::Service};

/// Longest time that a kill waits for a job to come to a phase.
const PATIENCE: Duration = Duration::from_secs(20);
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// What is killed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Target {
    Worker,
    Service,
    Both,
    /// A service that is starting, after one that was killed with its workers.
    Starting,
}

/// When.
#[derive(Debug, Clone, Copy)]
enum Moment {
    AnyTime,
    /// Soon after a job has come to this phase.
    During(&'static str),
}

/// Kills the processes of one deployment.
pub(super) struct Killer<'a> {
    deployment: &'a Deployment,
    workers: usize,
    random: Pcg64,
    /// There is always one, but for moments in between.
    service: Option<Service>,
    address: Arc<Mutex<String>>,
    log: String,
    starts: u32,
    /// Kills by target, and by what the victims were doing.
    kills: BTreeMap<(Target, String), u32>,
}

impl<'a> Killer<'a> {
    pub(super) async fn start(deployment: &'a Deployment, workers: usize, seed: u64) -> Self {
        let service = deployment.start(workers).await;
        let address = Arc::new(Mutex::new(service.address().to_owned()));
        Self {
            deployment,
            workers,
            random: Pcg64::seed_from_u64(seed),
            service: Some(service),
            address,
            log: String::new(),
            starts: 1,
            kills: BTreeMap::new(),
        }
    }

    /// Where the service is, now and after later starts.
    pub(super) fn address(&self) -> Arc<Mutex<String>> {
        Arc::clone(&self.address)
    }

    pub(super) async fn kill(&mut self, kills: u32) {
        let mut done = 0;
        while done < kills {
            self.wait().await;
            done += match self.random.random_range(0..20) {
                0..9 => self.kill_worker().await,
                9..16 => self.kill_both().await,
                16..18 => self.kill_service().await,
                _ => self.kill_both().await + self.kill_starting().await,
            };
            if self.service.is_none() {
                self.start_again().await;
            }
        }
    }

    /// Waits until the next random moment.
    async fn wait(&mut self) {
        let moment = match self.random.random_range(0..12) {
            0..4 => Moment::AnyTime,
            4 => Moment::During("ingest"),
            5..8 => Moment::During("train"),
            8 | 9 => Moment::During("encode"),
            10 => Moment::During("evaluate"),
            _ => Moment::During("publish"),
        };
        let further = match moment {
            Moment::AnyTime => self.random.random_range(0..6000),
            Moment::During(phase) => {
                let began = Instant::now();
                let running =
                    format!("SELECT count(*) FROM jobs WHERE state = 'running' AND phase = '{phase}'");
                while self.deployment.database.number(&running).await == 0 && began.elapsed() < PATIENCE {
                    sleep(LOOK_EVERY).await;
                }
                // Publication takes milliseconds, training seconds.
                self.random.random_range(0..if phase == "train" { 1500 } else { 40 })
            }
        };
        sleep(Duration::from_millis(further)).await;
    }

    /// Kills a worker alone. A job whose worker alone has died before, at the same checkpoint, is given up by design when that happens
    /// again, so then a power cut takes its place.
    async fn kill_worker(&mut self) -> u32 {
        let service = self.service.as_ref().expect("running");
        eventually("a worker lives", async || !service.workers().is_empty()).await;
        let workers = service.workers();
        let worker = workers[self.random.random_range(0..workers.len())];
        // Stopped first, so that the job that it has is known.
        signal("-STOP", worker);
        let at_risk = "SELECT count(*) FROM jobs WHERE state IN ('queued', 'running') AND silent_deaths > 0
            AND checkpoint_step <= setback_step";
        if self.deployment.database.number(at_risk).await > 0 {
            signal("-CONT", worker);
            return self.kill_both().await;
        }
        let doing = self.doing(&[worker]).await;
        signal("-KILL", worker);
        self.count(Target::Worker, doing)
    }

    async fn kill_both(&mut self) -> u32 {
        let service = self.service.take().expect("running");
        let doing = self.doing(&service.workers()).await;
        self.keep_log(&service);
        service.cut_power().await;
        self.count(Target::Both, doing)
    }

    /// Kills a service alone. Its workers see that, and return their jobs.
    async fn kill_service(&mut self) -> u32 {
        let service = self.service.take().expect("running");
        let doing = self.doing(&service.workers()).await;
        self.keep_log(&service);
        service.kill().await;
        self.count(Target::Service, doing)
    }

    /// Kills a service that has just been started, whether it is ready or not.
    async fn kill_starting(&mut self) -> u32 {
        let patience = Duration::from_millis(self.random.random_range(0..1500));
        // One that is not ready in time is killed by being dropped.
        let doing = match timeout(patience, self.deployment.start(self.workers)).await {
            Ok(service) => {
                self.keep_log(&service);
                service.cut_power().await;
                "just ready"
            }
            Err(_) => "not ready",
        };
        self.starts += 1;
        self.count(Target::Starting, doing.to_owned())
    }

    async fn start_again(&mut self) {
        let service = self.deployment.start(self.workers).await;
        *self.address.lock().expect("not poisoned") = service.address().to_owned();
        self.service = Some(service);
        self.starts += 1;
    }

    /// The phases of the jobs that these workers have.
    async fn doing(&self, workers: &[u32]) -> String {
        let running = "SELECT lease_owner, phase FROM jobs WHERE state = 'running'";
        let running = self.deployment.database.rows(running, 2).await;
        let ids: Vec<String> = workers.iter().map(|pid| worker_id(*pid)).collect();
        let mut phases: Vec<String> =
            running.into_iter().filter(|row| ids.contains(&row[0])).map(|mut row| row.remove(1)).collect();
        phases.sort();
        if phases.is_empty() { "idle or starting".into() } else { phases.join(" + ") }
    }

    fn count(&mut self, target: Target, doing: String) -> u32 {
        *self.kills.entry((target, doing)).or_default() += 1;
        1
    }

    fn keep_log(&mut self, service: &Service) {
        self.log += &service.log();
    }

    /// What services and workers have logged.
    pub(super) fn log(&self) -> String {
        let last = self.service.as_ref().map(Service::log).unwrap_or_default();
        format!("{}{last}", self.log)
    }

    /// Ends the last service in order, and returns the log of all.
    pub(super) async fn stop(&mut self) -> String {
        let log = self.log();
        assert!(self.service.take().expect("running").stop().await.success(), "{log}");
        log
    }

    /// Kills by target and phase.
    pub(super) fn table(&self) -> String {
        let total: u32 = self.kills.values().sum();
        let mut table = format!("{total} kills, {} starts of services\n", self.starts);
        for ((target, doing), count) in &self.kills {
            let _ = writeln!(table, "{:10} {doing:28} {count:4}", format!("{target:?}"));
        }
        table
    }
}

/// The identity that a supervisor has given a worker.
fn worker_id(pid: u32) -> String {
    let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
    let variables = environment.split(|byte| *byte == 0).map(String::from_utf8_lossy);
    let id = variables.filter_map(|line| Some(line.strip_prefix("TCGS_WORKER_ID=")?.to_owned())).next();
    id.unwrap_or_default()
}

/// Sends a signal to a process that may just have ended.
fn signal(signal: &str, pid: u32) {
    let _ = Command::new("kill").args([signal, &pid.to_string()]).output();
}
