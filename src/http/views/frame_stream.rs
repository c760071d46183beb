//! A sequence of pictures as one response body, each sent as soon as it is rendered.
//!
//! Invariants: a picture is rendered only once the client has read the one before the last, so memory is bounded by two pictures; while
//! a job trains, a stream pauses after each picture for as long as it took to render, so it uses at most half of a shared adapter;
//! an error of the first picture becomes a problem, since the response has not begun; after a later error the connection is broken
//! off, so that the body does not look complete.

use std::{
    io,
    pin::pin,
    time::{Duration, Instant},
};

use axum::{
    body::Body,
    http::{HeaderValue, header},
    response::IntoResponse as _,
};
use bytes::Bytes;
use futures_util::stream;
use tokio::{
    sync::mpsc::{self, Sender},
    time::{Interval, MissedTickBehavior, interval, sleep},
};
use tracing::Instrument as _;

use super::{
    apng::Apng,
    key::{Frame, ViewKey},
    picture::Picture,
    queue::QueueSlot,
    view_renderer::{picture, render_with_permit},
};
use crate::{
    domain::KeyId,
    http::{
        auth::revocation::revoked,
        problem::{ApiResult, ProblemResponse},
        state::AppState,
    },
};

/// The pictures of a response, how often and how fast they are shown.
#[derive(Debug)]
pub(super) struct FrameStream {
    /// One round of it.
    pub(super) frames: Vec<Frame>,
    pub(super) rounds: u32,
    /// Time between pictures; as fast as possible if `None`.
    pub(super) every: Option<Duration>,
    pub(super) stop: StopCondition,
}

/// When a stream ends.
#[derive(Debug, Clone, Copy)]
pub(super) enum StopCondition {
    /// After its last picture.
    WhenDone,
    /// Also when the server shuts down or this key is revoked.
    Revoked(Option<KeyId>),
}

impl StopCondition {
    async fn early(self, state: AppState) {
        match self {
            Self::WhenDone => std::future::pending().await,
            Self::Revoked(key) => tokio::select! {
                () = state.draining.cancelled() => {}
                () = revoked(state.clone(), key) => {}
            },
        }
    }
}

/// The format of the body.
#[derive(Debug)]
pub(super) enum BodyFormat {
    Multipart(Multipart),
    /// An animated PNG.
    Apng {
        frames_per_second: u16,
    },
}

/// The kinds of multipart body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Multipart {
    /// Separate files.
    Mixed,
    /// Each replaces the one before it.
    Replace,
}

/// The state of a body that is being written.
enum BodyEncoder {
    Multipart { kind: Multipart, boundary: String },
    Apng(Option<Apng>),
}

/// A message to the response body; `End` distinguishes the end from a failed encoder.
enum Piece {
    More(Bytes),
    End,
}

impl FrameStream {
    /// The response; the slot is held until the last picture.
    pub(super) async fn answer(self, state: &AppState, mut slot: QueueSlot, format: BodyFormat) -> ApiResult {
        let (mut encoder, media_type) = self.encoder(&format)?;
        let mut clock = self.every.map(interval);
        if let Some(clock) = &mut clock {
            // Pictures that were late are not sent faster afterwards.
            clock.set_missed_tick_behavior(MissedTickBehavior::Delay);
            clock.tick().await;
        }
        let (first, render_time) =
            encoder.piece(state, &mut slot, self.frames[0].clone(), 0, self.len() == 1).await?;
        let (sender, receiver) = mpsc::channel(1);
        // The channel has capacity for one.
        let _ = sender.try_send(Piece::More(first));
        let producer = FrameProducer { state: state.clone(), slot, encoder, stream: self, render_time };
        tokio::spawn(producer.run(clock, sender).in_current_span());
        let body = stream::unfold(Some(receiver), |receiver| async {
            let mut receiver = receiver?;
            match receiver.recv().await {
                Some(Piece::More(bytes)) => Some((Ok(bytes), Some(receiver))),
                Some(Piece::End) => None,
                None => Some((Err(io::Error::from(io::ErrorKind::UnexpectedEof)), None)),
            }
        });
        Ok(([(header::CONTENT_TYPE, media_type)], Body::from_stream(body)).into_response())
    }

    /// The key of the whole stream in a format.
    pub(super) fn key(&self, how: &str) -> ViewKey {
        ViewKey::of_many(self.frames.iter().map(Frame::key), how)
    }

    /// Number of pictures in all rounds.
    fn len(&self) -> u64 {
        self.frames.len() as u64 * u64::from(self.rounds)
    }

    fn encoder(&self, format: &BodyFormat) -> ApiResult<(BodyEncoder, HeaderValue)> {
        match *format {
            BodyFormat::Multipart(kind) => {
                let boundary = self.key("parts").boundary();
                let media_type = match kind {
                    Multipart::Mixed => "multipart/mixed",
                    Multipart::Replace => "multipart/x-mixed-replace",
                };
                let media_type = HeaderValue::try_from(format!("{media_type}; boundary={boundary}"));
                let media_type = media_type?;
                Ok((BodyEncoder::Multipart { kind, boundary }, media_type))
            }
            BodyFormat::Apng { frames_per_second } => {
                let size = self.frames[0].spec.camera.intrinsics;
                let frames = u32::try_from(self.frames.len()).unwrap_or(u32::MAX);
                let file = Apng::new(size.width, size.height, frames, frames_per_second)
                    .map_err(|error| ProblemResponse::internal(&error))?;
                Ok((BodyEncoder::Apng(Some(file)), HeaderValue::from_static("image/apng")))
            }
        }
    }
}

/// Renders the rest of a stream while the client reads.
struct FrameProducer {
    state: AppState,
    slot: QueueSlot,
    encoder: BodyEncoder,
    stream: FrameStream,
    /// How long the last picture took to render.
    render_time: Duration,
}

impl FrameProducer {
    /// Renders and sends pictures until the last, or until the connection ends.
    ///
    /// It sets no time to read a picture in: the connection ends if its client reads too little.
    async fn run(mut self, mut clock: Option<Interval>, sender: Sender<Piece>) {
        let mut early = pin!(self.stream.stop.early(self.state.clone()));
        for index in 1..self.stream.len() {
            // Reserve first, so that nothing is rendered before the client can read it.
            let slot = tokio::select! {
                () = &mut early => break,
                slot = sender.reserve() => slot,
            };
            let Ok(slot) = slot else {
                tracing::debug!("the client has gone after {index} pictures");
                return;
            };
            let piece = tokio::select! {
                () = sender.closed() => return,
                () = &mut early => break,
                piece = self.piece(&mut clock, index) => piece,
            };
            match piece {
                Ok(bytes) => slot.send(Piece::More(bytes)),
                Err(fault) => {
                    tracing::warn!("broken off after {index} pictures: {fault:?}");
                    return;
                }
            }
        }
        // A client that has disconnected misses nothing.
        let _ = sender.send(Piece::End).await;
    }

    async fn piece(&mut self, clock: &mut Option<Interval>, index: u64) -> ApiResult<Bytes> {
        if !self.render_time.is_zero() && training(&self.state).await {
            sleep(self.render_time).await;
        }
        if let Some(clock) = clock {
            clock.tick().await;
        }
        let frame = self.stream.frames[(index % self.stream.frames.len() as u64) as usize].clone();
        let is_last = index + 1 == self.stream.len();
        let (bytes, render_time) =
            self.encoder.piece(&self.state, &mut self.slot, frame, index, is_last).await?;
        self.render_time = render_time;
        Ok(bytes)
    }
}

/// Whether a job is running; false if the database fails.
async fn training(state: &AppState) -> bool {
    state.store().has_running_job().await.unwrap_or(false)
}

impl BodyEncoder {
    /// The bytes of the next picture, and its render time.
    async fn piece(
        &mut self,
        state: &AppState,
        slot: &mut QueueSlot,
        frame: Frame,
        index: u64,
        is_last: bool,
    ) -> ApiResult<(Bytes, Duration)> {
        match self {
            BodyEncoder::Multipart { kind, boundary } => {
                let (picture, timing) = picture(state, slot, frame).await?;
                Ok((part(*kind, boundary, &picture, index, is_last), timing.render_time()))
            }
            BodyEncoder::Apng(file) => {
                slot.begin_picture();
                let permit = slot.permit().await;
                let animation =
                    file.take().ok_or_else(|| ProblemResponse::internal(&io::Error::other("no file")))?;
                let began = Instant::now();
                let (next, bytes) = render_with_permit(state, permit, frame, move |rendered, _| {
                    animation.add(&rendered, is_last)
                })
                .await?;
                *file = next;
                Ok((bytes, began.elapsed()))
            }
        }
    }
}

/// A part with its head, and the delimiter after it, since readers show a part only after the delimiter.
fn part(kind: Multipart, boundary: &str, picture: &Picture, index: u64, is_last: bool) -> Bytes {
    let mut text = String::new();
    if index == 0 {
        text.push_str(&format!("--{boundary}\r\n"));
    }
    let (media_type, length) = (picture.media_type(), picture.bytes.len());
    text.push_str(&format!("Content-Type: {media_type}\r\nContent-Length: {length}\r\n"));
    if kind == Multipart::Mixed {
        let extension = picture.extension();
        text.push_str(&format!("Content-Disposition: inline; filename=\"{index}.{extension}\"\r\n"));
    }
    if let Some(scale) = picture.depth_scale() {
        text.push_str(&format!("X-Depth-Scale: {scale}\r\n"));
    }
    text.push_str("\r\n");
    let end = if is_last { "--" } else { "" };
    [text.as_bytes(), &picture.bytes, format!("\r\n--{boundary}{end}\r\n").as_bytes()].concat().into()
}
