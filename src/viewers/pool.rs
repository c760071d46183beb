//! The viewers that a replica knows, and which of them renders a scene.

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    error::Error,
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use reqwest::{Client, header::CONTENT_TYPE};
use sha2::{Digest as _, Sha256};
use thiserror::Error;
use tokio::{runtime::Handle, sync::watch, time::sleep};
use tokio_util::sync::CancellationToken;

use super::protocol;
use crate::{
    domain::{Clock, Digest, Problem, ProblemType},
    https,
    store::{Store, ViewerRecord},
};

/// How often the list of viewers is read.
const REFRESH: Duration = Duration::from_secs(1);

/// How long a viewer that did not answer is asked last.
const AVOIDED: Duration = Duration::from_secs(10);

/// Longest time to reach a viewer.
const CONNECT: Duration = Duration::from_secs(3);

/// Longest time of a picture or an export. A viewer that dies is noticed by its connection, one that hangs by the list of viewers.
const ANSWER: Duration = Duration::from_secs(1800);

/// How long an answer is still waited for after its viewer has left the list: one that stops withdraws first, and then finishes its
/// open requests within this time, the default of a server's `drain`.
const FINISHING: Duration = Duration::from_secs(20);

/// After this time without a packet, a connection is probed, as often again at this interval as below.
const PROBE_EVERY: Duration = Duration::from_secs(5);
const PROBES: u32 = 3;

/// What is told of viewers that cannot be reached.
const SILENT: &str = "the viewers do not answer";

/// Problems of one viewer's device, which another may not have.
const UNFIT: [ProblemType; 3] =
    [ProblemType::DeviceLost, ProblemType::DeviceTimeout, ProblemType::DeviceFault];

/// No viewer can be asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("no viewer is alive; views and exports need a running 'tcgs viewer'")]
pub struct NoViewer;

impl From<NoViewer> for Problem {
    fn from(none: NoViewer) -> Self {
        Problem::new(ProblemType::NoViewer, none.to_string())
    }
}

/// Identifies a viewer process.
type ProcessKey = (String, String);

/// The viewers of the list as it was read last, and those that left it lately.
#[derive(Debug, Default)]
struct KnownViewers {
    alive: Vec<ViewerRecord>,
    /// Those that may be finishing their requests, and since when.
    finishing: BTreeMap<ProcessKey, Duration>,
}

impl KnownViewers {
    fn update(&mut self, alive: Vec<ViewerRecord>, now: Duration) {
        let left = std::mem::replace(&mut self.alive, alive);
        for viewer in &left {
            self.finishing.entry(process(viewer)).or_insert(now);
        }
        let alive: Vec<ProcessKey> = self.alive.iter().map(process).collect();
        self.finishing
            .retain(|process, since| !alive.contains(process) && now.saturating_sub(*since) < FINISHING);
    }

    fn may_answer(&self, viewer: &ViewerRecord) -> bool {
        let key = process(viewer);
        self.alive.iter().any(|other| process(other) == key) || self.finishing.contains_key(&key)
    }
}

/// The viewers that a replica knows.
pub struct ViewerPool {
    store: Store,
    clock: Arc<dyn Clock>,
    client: Client,
    runtime: Handle,
    viewers: watch::Sender<KnownViewers>,
    /// Those that did not answer, and when.
    silent: Mutex<BTreeMap<ProcessKey, Duration>>,
}

impl fmt::Debug for ViewerPool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ViewerPool").field("viewers", &self.viewers).finish_non_exhaustive()
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn process(viewer: &ViewerRecord) -> ProcessKey {
    (viewer.url.clone(), viewer.token.expose().to_owned())
}

impl ViewerPool {
    /// A pool that knows no viewer yet. Its pictures block on `runtime`.
    ///
    /// # Errors
    /// If no TLS client can be built.
    pub fn new(
        store: Store,
        clock: Arc<dyn Clock>,
        runtime: Handle,
    ) -> Result<Self, Box<dyn Error + Send + Sync>> {
        let client = https::client_builder()?
            .connect_timeout(CONNECT)
            .timeout(ANSWER)
            // Less than a viewer keeps an idle connection.
            .pool_idle_timeout(Duration::from_secs(5))
            .tcp_keepalive(PROBE_EVERY)
            .tcp_keepalive_interval(PROBE_EVERY)
            .tcp_keepalive_retries(PROBES)
            .redirect(reqwest::redirect::Policy::none())
            // Viewers are machines of this service.
            .no_proxy()
            .build()?;
        let (viewers, silent) = (watch::Sender::default(), Mutex::default());
        Ok(Self { store, clock, client, runtime, viewers, silent })
    }

    /// Reads the list again and again until `shutdown`. While the database does not answer, the last list stays.
    pub async fn watch(self: Arc<Self>, shutdown: CancellationToken) {
        while !shutdown.is_cancelled() {
            self.refresh().await;
            tokio::select! {
                () = sleep(REFRESH) => {}
                () = shutdown.cancelled() => {}
            }
        }
    }

    /// Reads the list.
    pub async fn refresh(&self) {
        let mut found = match self.store.live_viewers().await {
            Ok(found) => found,
            Err(error) => {
                tracing::warn!(error = &error as &dyn Error, "the list of viewers cannot be read: {error}");
                return;
            }
        };
        found.retain(|viewer| viewer.version == env!("CARGO_PKG_VERSION"));
        let alive: Vec<ProcessKey> = found.iter().map(process).collect();
        locked(&self.silent).retain(|process, _| alive.contains(process));
        let known = self.len();
        self.viewers.send_modify(|viewers| viewers.update(found, self.clock.elapsed()));
        if known != alive.len() {
            tracing::info!("{} viewers are alive", alive.len());
        }
    }

    /// How many viewers are known to be alive.
    #[must_use]
    pub fn len(&self) -> usize {
        self.viewers.borrow().alive.len()
    }

    /// Whether no viewer is known to be alive.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The viewers in the order in which a scene's replica asks them: rendezvous hashing, so that viewers that come and go move only their
    /// own scenes; those that lately did not answer last.
    pub(super) fn in_order(&self, artifact: Digest) -> Vec<ViewerRecord> {
        let mut viewers = self.viewers.borrow().alive.clone();
        let now = self.clock.elapsed();
        let silent = locked(&self.silent);
        viewers.sort_by_cached_key(|viewer| {
            let is_silent =
                silent.get(&process(viewer)).is_some_and(|since| now.saturating_sub(*since) < AVOIDED);
            let mut hash = Sha256::new();
            hash.update(artifact.as_bytes());
            hash.update(viewer.url.as_bytes());
            (is_silent, Reverse(hash.finalize()))
        });
        viewers
    }

    /// The answer of the first of the viewers that answers; blocks.
    pub(super) fn ask(
        &self,
        viewers: &[ViewerRecord],
        path: &str,
        request: &impl serde::Serialize,
    ) -> Result<Vec<u8>, Problem> {
        let message = protocol::write(request, &[]).map_err(|error| unexpected(&error))?;
        let mut last = Problem::from(NoViewer);
        for viewer in viewers {
            match self.runtime.block_on(self.send_while_announced(viewer, path, message.clone())) {
                Ok(answer) => return Ok(answer),
                Err(SendError::Answered(problem)) => return Err(problem),
                Err(SendError::Unfit(problem)) => last = problem,
                Err(SendError::Silent(error)) => {
                    last = Problem::new(ProblemType::NoViewer, SILENT);
                    tracing::warn!(error = &error as &dyn Error, "viewer {} does not answer", viewer.url);
                }
                Err(SendError::Unannounced) => {
                    last = Problem::new(ProblemType::NoViewer, SILENT);
                    tracing::warn!("viewer {} does not answer and is no longer announced", viewer.url);
                }
            }
            locked(&self.silent).insert(process(viewer), self.clock.elapsed());
        }
        Err(last)
    }

    /// Sends a request and waits for the answer as long as the viewer may give one.
    async fn send_while_announced(
        &self,
        viewer: &ViewerRecord,
        path: &str,
        message: Vec<u8>,
    ) -> Result<Vec<u8>, SendError> {
        let mut viewers = self.viewers.subscribe();
        tokio::select! {
            answer = self.send(viewer, path, message) => answer,
            Ok(_) = viewers.wait_for(|known| !known.may_answer(viewer)) => Err(SendError::Unannounced),
        }
    }

    async fn send(&self, viewer: &ViewerRecord, path: &str, message: Vec<u8>) -> Result<Vec<u8>, SendError> {
        let request = self
            .client
            .post(format!("{}{path}", viewer.url))
            .bearer_auth(viewer.token.expose())
            .header(CONTENT_TYPE, "application/octet-stream")
            .body(message);
        let response = request.send().await.map_err(SendError::Silent)?;
        let status = response.status();
        let body = response.bytes().await.map_err(SendError::Silent)?;
        if status.is_success() {
            return Ok(body.into());
        }
        if status == reqwest::StatusCode::UNAUTHORIZED {
            // Another process has taken its address over, and is in the list soon.
            return Err(SendError::Unfit(Problem::new(ProblemType::NoViewer, SILENT)));
        }
        let problem: Problem = serde_json::from_slice(&body).unwrap_or_else(|_| {
            let detail = format!("viewer {} answered {status} without a problem", viewer.url);
            Problem::new(ProblemType::UnexpectedAnswer, detail)
        });
        let is_unfit = UNFIT.into_iter().any(|kind| problem.is(kind));
        Err(if is_unfit { SendError::Unfit(problem) } else { SendError::Answered(problem) })
    }
}

/// Why a viewer gave no picture.
enum SendError {
    /// It cannot be reached, or its connection ended.
    Silent(reqwest::Error),
    /// It has not answered, and left the list of viewers a while ago: it hangs, or its network is cut.
    Unannounced,
    /// It cannot render now; another may.
    Unfit(Problem),
    /// The request has this problem with any viewer.
    Answered(Problem),
}

/// The problem for an answer that is none.
pub(super) fn unexpected(error: &(dyn Error + 'static)) -> Problem {
    tracing::error!(error, "a viewer's message cannot be used: {error}");
    Problem::new(
        ProblemType::UnexpectedAnswer,
        "a viewer's message cannot be used; the log has the particulars",
    )
}
