//! A sequence of pictures as one response body, each sent as soon as it is encoded.
//!
//! Invariants: a picture is rendered once the one before it is, while that one is encoded; at most [`MAX_AHEAD`] pictures are made
//! before the client reads them, so memory is bounded; while a job trains, a stream waits for each picture and then pauses for as long
//! as it took, so it uses at most half of a shared adapter; an error of the first picture becomes a problem, since the response has not
//! begun; after a later error the connection is broken off, so that the body does not look complete.

use std::{io, pin::pin, sync::Arc, time::Duration};

use axum::{
    body::Body,
    http::{HeaderValue, header},
    response::IntoResponse as _,
};
use bytes::Bytes;
use futures_util::stream;
use tokio::{
    sync::{
        mpsc::{self, Receiver, Sender},
        watch,
    },
    time::{Interval, MissedTickBehavior, interval, sleep},
};
use tokio_util::task::AbortOnDropHandle;
use tracing::Instrument as _;

use crate::{
    domain::Credential,
    http::{
        auth::revocation::revoked,
        problem::ApiResult,
        rendering::{Picture, QueueSlot, RenderFrame, ViewKey, failed},
        state::AppState,
    },
    picture::{Apng, WebpAnimation},
};

/// Pictures that are made before the client reads them, and at most one a core.
const MAX_AHEAD: usize = 4;

/// The pictures of a response, how often and how fast they are shown.
#[derive(Debug)]
pub(super) struct FrameStream {
    /// One round of it.
    pub(super) frames: Vec<RenderFrame>,
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
    /// Also when the server shuts down, or this key or link is revoked.
    Revoked(Credential),
}

impl StopCondition {
    async fn early(self, state: AppState) {
        match self {
            Self::WhenDone => std::future::pending().await,
            Self::Revoked(credential) => tokio::select! {
                () = state.draining.cancelled() => {}
                () = revoked(state.clone(), credential) => {}
            },
        }
    }
}

/// The format of the body.
#[derive(Debug, Clone)]
pub(super) enum BodyFormat {
    Multipart(Multipart),
    /// An animated PNG.
    Apng {
        frames_per_second: u16,
    },
    /// The frames of an animated WebP, whose head is written once all are there.
    WebpFrames(WebpAnimation),
}

/// The kinds of multipart body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Multipart {
    /// Separate files.
    Mixed,
    /// Separate files, as fields of a form: browsers read such a body without a parser of their own.
    Form,
    /// Each replaces the one before it.
    Replace,
}

/// Writes pictures as parts of a body.
#[derive(Debug, Clone)]
enum BodyEncoder {
    Multipart { kind: Multipart, boundary: Arc<str> },
    Apng(Apng),
    WebpFrames(WebpAnimation),
}

/// A message to the response body; `End` distinguishes the end from a producer that has failed.
enum Piece {
    First(Bytes),
    /// The picture of this number, while it is made.
    Started(u64, AbortOnDropHandle<ApiResult<Bytes>>),
    End,
}

/// How far a picture is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Progress {
    Waiting,
    Rendered,
    /// The time that it took without waiting; zero if it was cached.
    Finished(Duration),
}

impl FrameStream {
    /// The response; the slot is held until the last picture.
    pub(super) async fn answer(self, state: &AppState, slot: QueueSlot, format: BodyFormat) -> ApiResult {
        let (encoder, media_type) = self.encoder(&format)?;
        let mut clock = self.every.map(interval);
        if let Some(clock) = &mut clock {
            // Pictures that were late are not sent faster afterwards.
            clock.set_missed_tick_behavior(MissedTickBehavior::Delay);
            clock.tick().await;
        }
        let mut producer = FrameProducer {
            state: state.clone(),
            slot: Arc::new(slot),
            encoder,
            stream: Arc::new(self),
            latest: watch::channel(Progress::Waiting).1,
        };
        let first = producer.piece(0).await?;
        let ahead = state.view_renderer.encoders().min(MAX_AHEAD);
        let (sender, receiver) = mpsc::channel(ahead);
        // The channel has capacity for one.
        let _ = sender.try_send(Piece::First(first));
        tokio::spawn(producer.run(clock, sender).in_current_span());
        let body = stream::unfold(Some(receiver), |receiver| async {
            let mut receiver = receiver?;
            match next_bytes(&mut receiver).await {
                Ok(bytes) => bytes.map(|bytes| (Ok(bytes), Some(receiver))),
                Err(error) => Some((Err(error), None)),
            }
        });
        Ok(([(header::CONTENT_TYPE, media_type)], Body::from_stream(body)).into_response())
    }

    /// The key of the whole stream in a format.
    pub(super) fn key(&self, how: &str) -> ViewKey {
        ViewKey::of_many(self.frames.iter().map(RenderFrame::key), how)
    }

    /// Number of pictures in all rounds.
    fn len(&self) -> u64 {
        self.frames.len() as u64 * u64::from(self.rounds)
    }

    fn encoder(&self, format: &BodyFormat) -> ApiResult<(BodyEncoder, HeaderValue)> {
        match format.clone() {
            BodyFormat::Multipart(kind) => {
                let boundary = self.key("parts").to_string();
                let media_type = match kind {
                    Multipart::Mixed => "multipart/mixed",
                    Multipart::Form => "multipart/form-data",
                    Multipart::Replace => "multipart/x-mixed-replace",
                };
                let media_type = HeaderValue::try_from(format!("{media_type}; boundary={boundary}"));
                let media_type = media_type?;
                Ok((BodyEncoder::Multipart { kind, boundary: boundary.into() }, media_type))
            }
            BodyFormat::Apng { frames_per_second } => {
                let size = self.frames[0].spec.camera.intrinsics;
                let frames = u32::try_from(self.frames.len()).unwrap_or(u32::MAX);
                let file = Apng { frames, rate: frames_per_second, size: [size.width, size.height] };
                Ok((BodyEncoder::Apng(file), HeaderValue::from_static("image/apng")))
            }
            BodyFormat::WebpFrames(file) => {
                Ok((BodyEncoder::WebpFrames(file), HeaderValue::from_static("image/webp")))
            }
        }
    }
}

/// The next picture's part; `None` after the last.
async fn next_bytes(receiver: &mut Receiver<Piece>) -> io::Result<Option<Bytes>> {
    let unexpected_end = || io::Error::from(io::ErrorKind::UnexpectedEof);
    match receiver.recv().await {
        Some(Piece::First(bytes)) => Ok(Some(bytes)),
        Some(Piece::Started(index, piece)) => match piece.await {
            Ok(Ok(bytes)) => Ok(Some(bytes)),
            error => {
                tracing::warn!("broken off after {index} pictures: {error:?}");
                Err(unexpected_end())
            }
        },
        Some(Piece::End) => Ok(None),
        None => Err(unexpected_end()),
    }
}

/// Renders the rest of a stream while the client reads.
struct FrameProducer {
    state: AppState,
    slot: Arc<QueueSlot>,
    encoder: BodyEncoder,
    stream: Arc<FrameStream>,
    /// Of the latest picture.
    latest: watch::Receiver<Progress>,
}

impl FrameProducer {
    /// Renders and sends pictures until the last, or until the connection ends.
    ///
    /// It sets no time to read a picture in: the connection ends if its client reads too little.
    async fn run(mut self, mut clock: Option<Interval>, sender: Sender<Piece>) {
        let stream = Arc::clone(&self.stream);
        let mut early = pin!(stream.stop.early(self.state.clone()));
        for index in 1..self.stream.len() {
            // Reserve first, so that nothing is rendered for which the client has left no room.
            let room = tokio::select! {
                () = &mut early => break,
                room = sender.reserve() => room,
            };
            let Ok(room) = room else {
                tracing::debug!("the client has gone after {index} pictures");
                return;
            };
            tokio::select! {
                () = sender.closed() => return,
                () = &mut early => break,
                () = self.turn(&mut clock) => {}
            }
            let piece = tokio::spawn(self.piece(index).in_current_span());
            room.send(Piece::Started(index, AbortOnDropHandle::new(piece)));
        }
        // A client that has disconnected misses nothing.
        let _ = sender.send(Piece::End).await;
    }

    /// Waits until the next picture may be rendered.
    async fn turn(&mut self, clock: &mut Option<Interval>) {
        // A picture that failed has no progress; the body ends with it.
        let _ = self.latest.wait_for(|progress| *progress != Progress::Waiting).await;
        let was_cached = *self.latest.borrow() == Progress::Finished(Duration::ZERO);
        if !was_cached && training(&self.state).await {
            let _ = self.latest.wait_for(|progress| matches!(progress, Progress::Finished(_))).await;
            let pause = match *self.latest.borrow() {
                Progress::Finished(duration) => duration,
                Progress::Waiting | Progress::Rendered => Duration::ZERO,
            };
            sleep(pause).await;
        }
        if let Some(clock) = clock {
            clock.tick().await;
        }
    }

    /// Makes a picture, which becomes the latest.
    fn piece(&mut self, index: u64) -> impl Future<Output = ApiResult<Bytes>> + Send + use<> {
        let (progress, latest) = watch::channel(Progress::Waiting);
        self.latest = latest;
        let (state, slot, encoder) = (self.state.clone(), Arc::clone(&self.slot), self.encoder.clone());
        let frame = self.stream.frames[(index % self.stream.frames.len() as u64) as usize].clone();
        let is_last = index + 1 == self.stream.len();
        async move {
            let rendered = progress.clone();
            let on_rendered = move || _ = rendered.send_replace(Progress::Rendered);
            let (picture, timing) = state.view_renderer.picture(&slot, frame, on_rendered).await?;
            progress.send_replace(Progress::Finished(timing.render_time()));
            encoder.part(&picture, index, is_last)
        }
    }
}

/// Whether a job is running; false if the database fails.
async fn training(state: &AppState) -> bool {
    state.store().has_running_job().await.unwrap_or(false)
}

impl BodyEncoder {
    /// The part of the body with the picture of this number.
    fn part(&self, picture: &Picture, index: u64, is_last: bool) -> ApiResult<Bytes> {
        match self {
            Self::Multipart { kind, boundary } => Ok(part(*kind, boundary, picture, index, is_last)),
            Self::Apng(file) => {
                let index = u32::try_from(index).unwrap_or(u32::MAX);
                Ok(file.part(index, &picture.bytes).map_err(|error| failed(&error))?.into())
            }
            Self::WebpFrames(file) => {
                let index = u32::try_from(index).unwrap_or(u32::MAX);
                Ok(file.part(index, &picture.bytes).map_err(|error| failed(&error))?.into())
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
    let extension = picture.extension();
    let disposition = match kind {
        Multipart::Mixed => Some("inline".to_owned()),
        Multipart::Form => Some(format!("form-data; name=\"{index}\"")),
        Multipart::Replace => None,
    };
    if let Some(disposition) = disposition {
        text.push_str(&format!("Content-Disposition: {disposition}; filename=\"{index}.{extension}\"\r\n"));
    }
    if let Some(scale) = picture.depth_scale() {
        text.push_str(&format!("X-Depth-Scale: {scale}\r\n"));
    }
    text.push_str("\r\n");
    let end = if is_last { "--" } else { "" };
    [text.as_bytes(), &picture.bytes, format!("\r\n--{boundary}{end}\r\n").as_bytes()].concat().into()
}
