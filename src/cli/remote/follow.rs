//! Follows a job to its end: by its stream of events, gone on with wherever it broke off, else by asking.

use std::time::Duration;

use reqwest::{Method, StatusCode, header::ACCEPT};
use serde_json::Value;
use tcgs::domain::{Event, EventKind, JobId, Phase, Progress};

use super::{
    Connection,
    connection::sleep,
    job::{self, JobView},
    sse::{Message, Parser},
};
use crate::cli::{Failure, progress::Display};

/// Pause before a stream that broke off is asked for again, and between two questions where there is none.
const PAUSE: Duration = Duration::from_secs(1);
/// How often in a row a stream may break off without a single event before there is held to be none.
const MOST_BREAKS: u32 = 5;

/// How a stream ended.
enum Ended {
    /// With the job, or after all that there was to tell.
    Done,
    /// Before that.
    Broken,
    /// The service has none.
    Unavailable,
}

/// Waits until the job has ended, showing how it goes.
pub(super) async fn follow(connection: &Connection, id: JobId) -> Result<(Value, JobView), Failure> {
    let mut follower = Follower {
        connection,
        id,
        last: 0,
        display: Display::new(),
        phase: Phase::Queued,
        progress: Progress::default(),
    };
    let ended = follower.outcome().await;
    follower.display.finish();
    ended
}

struct Follower<'a> {
    connection: &'a Connection,
    id: JobId,
    /// Number of the last event seen.
    last: u64,
    display: Display,
    phase: Phase,
    progress: Progress,
}

impl Follower<'_> {
    async fn outcome(&mut self) -> Result<(Value, JobView), Failure> {
        let (whole, view) = job::get(self.connection, self.id).await?;
        if view.state.is_terminal() {
            return Ok((whole, view));
        }
        let mut breaks = 0;
        while breaks < MOST_BREAKS {
            let before = self.last;
            match self.stream().await? {
                Ended::Done => break,
                Ended::Unavailable => return self.ask().await,
                Ended::Broken if self.last > before => breaks = 0,
                Ended::Broken => breaks += 1,
            }
            sleep(PAUSE).await;
        }
        // The stream only tells that something changed; the job itself is what counts, and may still run.
        self.ask().await
    }

    /// Asks for the job until it has ended.
    async fn ask(&mut self) -> Result<(Value, JobView), Failure> {
        loop {
            let (whole, view) = job::get(self.connection, self.id).await?;
            if view.state.is_terminal() {
                return Ok((whole, view));
            }
            self.display.show(view.phase, &view.progress);
            sleep(PAUSE).await;
        }
    }

    /// Reads the stream of events from the last one seen on.
    async fn stream(&mut self) -> Result<Ended, Failure> {
        let events = format!("{}/events", job::path(self.id));
        let ask = self
            .connection
            .request(Method::GET, &events)?
            .header(ACCEPT, "text/event-stream")
            .header("last-event-id", self.last);
        let mut response = match ask.send().await {
            Ok(response) => response,
            Err(_) => return Ok(Ended::Broken),
        };
        match response.status() {
            StatusCode::OK => {}
            StatusCode::NO_CONTENT => return Ok(Ended::Done),
            // Asking instead tells what is wrong, if anything is.
            status if status.is_client_error() => return Ok(Ended::Unavailable),
            _ => return Ok(Ended::Broken),
        }
        let mut parser = Parser::default();
        while let Ok(Some(piece)) = response.chunk().await {
            let Ok(messages) = parser.take(&piece) else { return Ok(Ended::Unavailable) };
            for message in &messages {
                if self.take(message) {
                    return Ok(Ended::Done);
                }
            }
        }
        Ok(Ended::Broken)
    }

    /// Takes one event; true for the one that ends the job.
    fn take(&mut self, message: &Message) -> bool {
        // What is not understood is not needed either: newer services may tell more.
        let Ok(event) = serde_json::from_str::<Event>(&message.data) else { return false };
        if event.seq <= self.last {
            return false;
        }
        self.last = event.seq;
        match event.kind {
            EventKind::State => {
                return matches!(event.data["state"].as_str(), Some("succeeded" | "failed" | "cancelled"));
            }
            EventKind::Phase => {
                let Ok(phase) = serde_json::from_value(event.data["phase"].clone()) else { return false };
                self.phase = phase;
            }
            EventKind::Progress => {
                let Ok(progress) = serde_json::from_value(event.data) else { return false };
                self.progress = progress;
            }
            EventKind::Attempt => return false,
        }
        self.display.show(self.phase, &self.progress);
        false
    }
}
