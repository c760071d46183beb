//! `tcgs serve` in a process of its own, and a client that holds every answer to the contract.

use std::{
    ffi::OsStr,
    path::Path,
    process::{ExitStatus, Stdio},
    sync::{Arc, Mutex},
    time::Duration,
};

use reqwest::RequestBuilder;
use serde_json::Value;
use tokio::{
    io::{AsyncBufReadExt as _, BufReader},
    process::{Child, Command},
    sync::oneshot,
};

use super::{
    contract::Coverage,
    eventually::{PATIENCE, within},
    program,
    server::Answer,
};

/// A running service. Dropping it kills it, and its worker sees that and ends.
pub struct Service {
    child: Child,
    base: String,
    client: reqwest::Client,
    coverage: Coverage,
    log: Arc<Mutex<Vec<String>>>,
}

impl Service {
    /// Starts the service over the folder `data` on a port of the system's choice.
    pub async fn start(data: &Path) -> Self {
        Self::start_with(data, std::iter::empty::<&str>()).await
    }

    /// The same with more arguments.
    pub async fn start_with<A: AsRef<OsStr>>(data: &Path, more: impl IntoIterator<Item = A>) -> Self {
        Self::start_as(program::command(), data, more).await
    }

    /// The same with these variables.
    pub async fn start_in<A: AsRef<OsStr>>(
        data: &Path,
        more: impl IntoIterator<Item = A>,
        environment: &[(&str, String)],
    ) -> Self {
        let mut command = program::command();
        command.envs(environment.iter().map(|(name, value)| (name, value)));
        Self::start_as(command, data, more).await
    }

    /// The same of a program with settings of its own.
    pub async fn start_as<A: AsRef<OsStr>>(
        program: std::process::Command,
        data: &Path,
        more: impl IntoIterator<Item = A>,
    ) -> Self {
        let mut command = Command::from(program);
        command.args(["serve", "--listen", "127.0.0.1:0", "--log-format", "json", "--data"]).arg(data);
        command.args(more);
        let mut child = command.stderr(Stdio::piped()).kill_on_drop(true).spawn().expect("the binary runs");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let log: Arc<Mutex<Vec<String>>> = Arc::default();
        let (send, address) = oneshot::channel();
        let kept = Arc::clone(&log);
        tokio::spawn(async move {
            let mut send = Some(send);
            while let Ok(Some(line)) = lines.next_line().await {
                let entry: Value = serde_json::from_str(&line).unwrap_or_default();
                if let Some(address) = entry["address"].as_str()
                    && let Some(send) = send.take()
                {
                    send.send(address.to_owned()).expect("somebody waits for the address");
                }
                kept.lock().expect("not poisoned").push(line);
            }
        });
        let address = match within("the service listens", address).await {
            Ok(address) => address,
            Err(_) => panic!("the service did not start:\n{}", log.lock().expect("not poisoned").join("\n")),
        };
        let client = tcgs::https::client_builder()
            .expect("TLS")
            .timeout(Duration::from_secs(120))
            .build()
            .expect("a client");
        Self { child, base: format!("http://{address}"), client, coverage: Coverage::default(), log }
    }

    /// Sends a request and checks the answer against the contract.
    pub async fn send(
        &self,
        method: &str,
        path: &str,
        fill: impl FnOnce(RequestBuilder) -> RequestBuilder,
    ) -> Answer {
        let request = self.client.request(method.parse().expect("a method"), format!("{}{path}", self.base));
        let response = fill(request).send().await.expect("an answer");
        let (status, headers) = (response.status().as_u16(), response.headers().clone());
        let body = response.bytes().await.expect("a whole body");
        self.coverage.check(method, path, status, &headers, &body);
        Answer { status, headers, body }
    }

    pub async fn get(&self, path: &str) -> Answer {
        self.send("GET", path, |request| request).await
    }

    pub async fn post_json(&self, path: &str, body: &Value) -> Answer {
        self.send("POST", path, |request| request.json(body)).await
    }

    /// `POST /v1/jobs` with a query and a zip.
    pub async fn upload(&self, query: &str, zip: Vec<u8>) -> Answer {
        self.send("POST", &format!("/v1/jobs{query}"), |request| {
            request.header("content-type", "application/zip").body(zip)
        })
        .await
    }

    /// Asks for a job until `done` says so, and returns it as it then is.
    pub async fn job_until(&self, job: &str, mut done: impl FnMut(&Value) -> bool) -> Value {
        let wait = async {
            loop {
                let now = self.get(job).await.expect(200).json();
                if done(&now) {
                    return now;
                }
                assert!(now["finished_at"].is_null(), "the job ended: {now:#}\n{}", self.log());
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        };
        // Training with a cold cache of kernels takes minutes where processors are few.
        tokio::time::timeout(4 * PATIENCE, wait)
            .await
            .unwrap_or_else(|_| panic!("{job} stays as it is:\n{}", self.log()))
    }

    /// Waits until a job has succeeded.
    pub async fn succeeded(&self, job: &str) -> Value {
        self.job_until(job, |now| now["state"] == "succeeded").await
    }

    /// What the service and its workers have logged so far.
    pub fn log(&self) -> String {
        self.log.lock().expect("not poisoned").join("\n")
    }

    /// Process id of the service.
    #[cfg(target_os = "linux")]
    pub fn pid(&self) -> u32 {
        self.child.id().expect("running")
    }

    /// Process ids of the service's children.
    #[cfg(target_os = "linux")]
    pub fn workers(&self) -> Vec<u32> {
        let parent = self.child.id().expect("running").to_string();
        let processes = std::fs::read_dir("/proc").expect("a process list");
        processes
            .filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok())
            .filter(|pid: &u32| {
                // The name, in parentheses, may hold spaces; state and parent follow it.
                let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
                let mut fields = stat.rsplit_once(')').map_or("", |(_, fields)| fields).split_whitespace();
                fields.next().is_some_and(|state| state != "Z") && fields.next() == Some(&*parent)
            })
            .collect()
    }

    /// Ends the service as a power cut would.
    pub async fn kill(mut self) {
        self.child.kill().await.expect("killed");
    }

    /// Ends the service and its workers at once, so that neither sees the other's end, as a power cut would.
    #[cfg(target_os = "linux")]
    pub async fn cut_power(self) {
        kill("-STOP", self.child.id().expect("running"));
        for worker in self.workers() {
            kill("-KILL", worker);
        }
        self.kill().await;
    }

    /// Asks the service to stop and waits until it has.
    #[cfg(unix)]
    pub async fn stop(mut self) -> ExitStatus {
        kill("-TERM", self.child.id().expect("running"));
        within("the service has ended", self.child.wait()).await.expect("ended")
    }
}

impl Service {
    /// Where it listens, as `ADDRESS:PORT`.
    pub fn address(&self) -> &str {
        self.base.trim_start_matches("http://")
    }

    /// Asks the service to stop.
    #[cfg(unix)]
    pub fn ask_to_stop(&self) {
        kill("-TERM", self.child.id().expect("running"));
    }

    /// How the service ended, if it has.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("a child")
    }
}

/// Sends a signal to one process.
#[cfg(unix)]
pub fn kill(signal: &str, pid: u32) {
    let status = std::process::Command::new("kill").args([signal, &pid.to_string()]).status();
    assert!(status.expect("kill runs").success());
}
