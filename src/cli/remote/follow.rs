//! Follows a job to its end: by its event stream, resumed after each break, else by polling.

use std::{io, time::Duration};

use reqwest::{Method, StatusCode, header::ACCEPT};
use serde_json::Value;
use tcgs::domain::{Event, EventKind, JobId, Phase, ProblemType, Progress};
use tokio::time::Instant;

use super::{
    Connection, ServerFlags,
    connection::{next_piece, sleep},
    job::{self, JobView},
    sse::{Message, Parser},
};
use crate::cli::{CliError, progress::Display, signals::Signals};

/// Pause before reconnecting to the stream, and between polls.
const PAUSE: Duration = Duration::from_secs(1);
/// Breaks in a row without an event after which polling replaces the stream.
const MAX_BREAKS: u32 = 5;

/// How long a service may be away that has answered before: an upgrade drains, migrates and starts.
const MAX_OUTAGE: Duration = Duration::from_secs(300);

/// How a stream ended.
enum Ended {
    /// At the end of the job or of its events.
    Done,
    /// By a broken connection.
    Broken,
    /// The service has no stream.
    Unavailable,
}

/// Whether a service that starts again, or the proxy before it, fails like this.
fn is_away(error: &CliError) -> bool {
    let CliError::Problem(problem) = error else { return false };
    problem.is(ProblemType::Unreachable) || matches!(problem.status, 502..=504)
}

/// Waits until the job has ended and shows its progress. A signal ends the waiting, not the job.
pub(super) async fn follow(
    connection: &Connection,
    id: JobId,
    server: &ServerFlags,
) -> Result<(Value, JobView), CliError> {
    let mut follower = Follower {
        connection,
        id,
        last: 0,
        display: Display::new(),
        phase: Phase::Queued,
        progress: Progress::default(),
    };
    // Before anything is shown, so that no signal is missed.
    let signals = Signals::listen();
    let ended = tokio::select! {
        status = next(signals) => Err(stopped(status, id, server)),
        ended = follower.outcome() => ended,
    };
    follower.display.finish();
    ended
}

/// Waits for a signal; for ever, if none can be received.
async fn next(signals: io::Result<Signals>) -> u8 {
    match signals {
        Ok(mut signals) => signals.next().await,
        Err(_) => std::future::pending().await,
    }
}

fn stopped(status: u8, id: JobId, server: &ServerFlags) -> CliError {
    let [cancel, watch] = ["cancel", "watch"].map(|command| server.command_line(&format!("{command} {id}")));
    let advice = format!("the job goes on; cancel it with '{cancel}', or follow it again with '{watch}'");
    CliError::Stopped { status, advice }
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
    async fn outcome(&mut self) -> Result<(Value, JobView), CliError> {
        let (whole, view) = job::get(self.connection, self.id).await?;
        if view.state.is_terminal() {
            return Ok((whole, view));
        }
        let mut breaks = 0;
        while breaks < MAX_BREAKS {
            let before = self.last;
            match self.stream().await? {
                Ended::Done => break,
                Ended::Unavailable => return self.poll().await,
                Ended::Broken if self.last > before => breaks = 0,
                Ended::Broken => breaks += 1,
            }
            sleep(PAUSE).await;
        }
        // Events only say that something changed: the job itself decides, and may still run.
        self.poll().await
    }

    /// Polls the job until it has ended, also while the service is away for a while.
    async fn poll(&mut self) -> Result<(Value, JobView), CliError> {
        let mut answered = Instant::now();
        loop {
            let (whole, view) = match job::get(self.connection, self.id).await {
                Ok(found) => found,
                Err(error) if is_away(&error) && answered.elapsed() < MAX_OUTAGE => {
                    sleep(PAUSE).await;
                    continue;
                }
                Err(error) => return Err(error),
            };
            answered = Instant::now();
            if view.state.is_terminal() {
                return Ok((whole, view));
            }
            self.display.show(view.phase, &view.progress);
            sleep(PAUSE).await;
        }
    }

    /// Reads the event stream, starting after the last event seen.
    async fn stream(&mut self) -> Result<Ended, CliError> {
        let events = format!("{}/events", job::path(self.id));
        let ask = self
            .connection
            .request(Method::GET, &events)?
            .header(ACCEPT, "text/event-stream")
            .header("last-event-id", self.last);
        let mut response = match self.connection.response(ask).await {
            Ok(response) => response,
            Err(_) => return Ok(Ended::Broken),
        };
        match response.status() {
            StatusCode::OK => {}
            StatusCode::NO_CONTENT => return Ok(Ended::Done),
            // Polling reports what is wrong, if anything is.
            status if status.is_client_error() => return Ok(Ended::Unavailable),
            _ => return Ok(Ended::Broken),
        }
        let mut parser = Parser::default();
        while let Ok(Some(piece)) = next_piece(&mut response).await {
            let Ok(messages) = parser.take(&piece) else { return Ok(Ended::Unavailable) };
            for message in &messages {
                if self.take(message) {
                    return Ok(Ended::Done);
                }
            }
        }
        Ok(Ended::Broken)
    }

    /// Applies one event; returns true for the one that ends the job.
    fn take(&mut self, message: &Message) -> bool {
        // Newer services may send events that this version does not know.
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
