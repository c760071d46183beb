//! A client that sends jobs and follows them to their ends, whatever happens to the service meanwhile.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    time::Duration,
};

use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;
use reqwest::StatusCode;
use tokio::time::{sleep, timeout};

use super::RECIPES;
use crate::support::{
    dataset,
    sse::{Frame, Reader},
};

/// Pause before a request is repeated.
const PAUSE: Duration = Duration::from_millis(50);
/// Longest time of a request that is not cut off on purpose.
const LONGEST: Duration = Duration::from_secs(30);

/// A job with what its client has seen of it.
pub(super) struct Followed {
    pub(super) job: String,
    /// Its place in [`RECIPES`].
    pub(super) recipe: usize,
    pub(super) events: Vec<Frame>,
    /// How often the client connected to see them.
    pub(super) connections: u32,
}

pub(super) struct Client {
    http: reqwest::Client,
    /// Where the service is now.
    address: Arc<Mutex<String>>,
    random: Pcg64,
    archive: Vec<u8>,
    /// The number of the next job.
    next: Arc<AtomicU32>,
    /// Whether no more jobs are to be sent.
    over: Arc<AtomicBool>,
}

impl Client {
    pub(super) fn new(
        address: Arc<Mutex<String>>,
        seed: u64,
        number: u32,
        next: Arc<AtomicU32>,
        over: Arc<AtomicBool>,
    ) -> Self {
        let http = tcgs::https::client_builder().expect("TLS").build().expect("a client");
        let random = Pcg64::seed_from_u64(seed ^ (u64::from(number) + 1) << 32);
        Self { http, address, random, archive: dataset::zip(), next, over }
    }

    fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address.lock().expect("not poisoned"))
    }

    /// Sends one job after the other until it is over, each once the one before has ended.
    pub(super) async fn send_jobs(mut self) -> Vec<Followed> {
        let mut followed = Vec::new();
        while !self.over.load(Ordering::Relaxed) {
            let number = self.next.fetch_add(1, Ordering::Relaxed);
            let recipe = number as usize % RECIPES.len();
            let job = self.create(number, recipe).await;
            let (events, connections) = self.follow(&job).await;
            followed.push(Followed { job, recipe, events, connections });
        }
        followed
    }

    /// Creates a job, repeating the request until it is answered; some are cut off on purpose. Then once more, which changes nothing.
    async fn create(&mut self, number: u32, recipe: usize) -> String {
        let job = self.create_until_answered(number, recipe).await;
        if self.random.random_bool(0.3) {
            assert_eq!(self.create_until_answered(number, recipe).await, job, "one key, two jobs");
        }
        job
    }

    async fn create_until_answered(&mut self, number: u32, recipe: usize) -> String {
        loop {
            let patience = match self.random.random_bool(0.3) {
                true => Duration::from_millis(self.random.random_range(1..150)),
                false => LONGEST,
            };
            let request = self
                .http
                .post(self.url(&format!("/v1/jobs?{}", RECIPES[recipe])))
                .header("content-type", "application/zip")
                .header("idempotency-key", format!("soak-{number}"))
                .body(self.archive.clone());
            match timeout(patience, request.send()).await {
                Ok(Ok(answer)) if answer.status() == StatusCode::CREATED => {
                    let location = answer.headers()["location"].to_str().expect("ASCII");
                    return location.trim_start_matches("/v1/jobs/").to_owned();
                }
                // The request before is still under way, or the service is just ending or beginning.
                Ok(Ok(answer)) if matches!(answer.status().as_u16(), 409 | 503) => {}
                Ok(Ok(answer)) => {
                    panic!("{}: {}", answer.status(), answer.text().await.unwrap_or_default())
                }
                Ok(Err(_)) | Err(_) => {}
            }
            sleep(PAUSE).await;
        }
    }

    /// The events of a job to its end, each once, and the number of connections that this took.
    async fn follow(&self, job: &str) -> (Vec<Frame>, u32) {
        let (mut events, mut connections): (Vec<Frame>, _) = (Vec::new(), 0);
        loop {
            let mut request = self
                .http
                .get(self.url(&format!("/v1/jobs/{job}/events")))
                .header("accept", "text/event-stream");
            if let Some(last) = events.last() {
                request = request.header("last-event-id", &last.id);
            }
            match request.send().await {
                Ok(answer) if answer.status() == StatusCode::OK => {
                    connections += 1;
                    let mut reader = Reader::new(answer);
                    while let Some(event) = reader.next().await {
                        let state = event.json()["data"]["state"].as_str().unwrap_or_default().to_owned();
                        events.push(event);
                        assert!(!matches!(&*state, "failed" | "cancelled"), "job {job}: {events:#?}");
                        if state == "succeeded" {
                            return (events, connections);
                        }
                    }
                }
                Ok(answer) if answer.status() == StatusCode::SERVICE_UNAVAILABLE => {}
                Ok(answer) => panic!("{}: {}", answer.status(), answer.text().await.unwrap_or_default()),
                Err(_) => {}
            }
            sleep(PAUSE).await;
        }
    }
}
