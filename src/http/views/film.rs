//! Pictures in a row as one body, each sent as soon as it is there.
//!
//! What always holds: a picture is rendered only when the client has taken the one before the last, so memory is bounded by two
//! pictures whatever is asked for; while a job trains, a film rests after each picture for as long as the picture took, so it
//! takes no more than half of an adapter that the two share; what can go wrong with the first picture is told as a problem, before the answer begins;
//! a body that ends early is broken off, never ended as if it were whole.

use std::{
    io,
    pin::pin,
    time::{Duration, Instant},
};

use axum::{
    body::Body,
    http::{HeaderValue, header},
    response::{IntoResponse as _, Response},
};
use bytes::Bytes;
use futures_util::stream;
use tokio::{
    sync::mpsc::{self, Sender},
    time::{Interval, MissedTickBehavior, interval, sleep, timeout},
};
use tracing::Instrument as _;

use super::{
    apng::Apng,
    key::{Key, Shot},
    queue::Place,
    studio::{in_turn, picture},
};
use crate::{
    domain::{JobState, KeyId},
    http::{picture::Picture, problem::Fault, revocation::revoked, state::AppState},
    store::JobFilter,
};

/// What is shown, how often and how fast.
#[derive(Debug)]
pub(super) struct Film {
    /// One round of it.
    pub(super) shots: Vec<Shot>,
    pub(super) rounds: u32,
    /// Time from one picture to the next, if it is not as fast as can be.
    pub(super) every: Option<Duration>,
    pub(super) ends: Ends,
}

/// When a film ends.
#[derive(Debug, Clone, Copy)]
pub(super) enum Ends {
    /// After its last picture.
    WhenDone,
    /// Earlier if the server begins to stop or this key, if it is a key's, is revoked.
    With(Option<KeyId>),
}

impl Ends {
    async fn early(self, state: AppState) {
        match self {
            Self::WhenDone => std::future::pending().await,
            Self::With(key) => tokio::select! {
                () = state.draining().cancelled() => {}
                () = revoked(state.clone(), key) => {}
            },
        }
    }
}

/// How pictures become a body.
#[derive(Debug)]
pub(super) enum Wrapping {
    Parts(Parts),
    /// Frames of an animated PNG with so many a second.
    Apng {
        frames_per_second: u16,
    },
}

/// The kinds of multipart body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Parts {
    /// Files side by side.
    Mixed,
    /// Each takes the place of the one before it.
    Replace,
}

/// The making of a body.
enum Maker {
    Parts { parts: Parts, boundary: String },
    Apng(Option<Apng>),
}

/// What goes to the client's side of the channel; the end is said, so that a maker that died is told apart.
enum Piece {
    More(Bytes),
    End,
}

impl Film {
    /// The answer with the film as its body; the place is held until the last picture.
    pub(super) async fn answer(
        self,
        state: &AppState,
        mut place: Place,
        wrapping: Wrapping,
    ) -> Result<Response, Fault> {
        let (mut maker, media_type) = self.maker(state, &wrapping)?;
        let mut clock = self.every.map(interval);
        if let Some(clock) = &mut clock {
            // A client that is slow for a while is not sent faster afterwards.
            clock.set_missed_tick_behavior(MissedTickBehavior::Delay);
            clock.tick().await;
        }
        let (first, worked) = maker.piece(state, &mut place, self.shots[0], 0, self.len() == 1).await?;
        let (sender, receiver) = mpsc::channel(1);
        // There is room for one.
        let _ = sender.try_send(Piece::More(first));
        let patience = state.limits().body_idle;
        let crew = Crew { state: state.clone(), place, maker, film: self, patience, worked };
        tokio::spawn(crew.shoot(clock, sender).in_current_span());
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

    /// The key of the whole film, shown as `how` says.
    pub(super) fn key(&self, state: &AppState, how: &str) -> Key {
        Key::of_many(self.shots.iter().map(|shot| state.studio().key(shot)), how)
    }

    /// Pictures in all.
    fn len(&self) -> u64 {
        self.shots.len() as u64 * u64::from(self.rounds)
    }

    fn maker(&self, state: &AppState, wrapping: &Wrapping) -> Result<(Maker, HeaderValue), Fault> {
        match *wrapping {
            Wrapping::Parts(parts) => {
                let boundary = self.key(state, "parts").boundary();
                let kind = match parts {
                    Parts::Mixed => "multipart/mixed",
                    Parts::Replace => "multipart/x-mixed-replace",
                };
                let media_type = HeaderValue::try_from(format!("{kind}; boundary={boundary}"));
                let media_type = media_type.map_err(|error| Fault::internal(&error))?;
                Ok((Maker::Parts { parts, boundary }, media_type))
            }
            Wrapping::Apng { frames_per_second } => {
                let size = self.shots[0].camera.intrinsics;
                let frames = u32::try_from(self.shots.len()).unwrap_or(u32::MAX);
                let file = Apng::new(size.width, size.height, frames, frames_per_second)
                    .map_err(|error| Fault::internal(&error))?;
                Ok((Maker::Apng(Some(file)), HeaderValue::from_static("image/apng")))
            }
        }
    }
}

/// Whoever makes the rest of a film while the client reads.
struct Crew {
    state: AppState,
    place: Place,
    maker: Maker,
    film: Film,
    /// How long a client may take nothing.
    patience: Duration,
    /// What the last picture took to make.
    worked: Duration,
}

impl Crew {
    /// Makes and sends pictures until the last, or until the client is gone or has stopped reading.
    async fn shoot(mut self, mut clock: Option<Interval>, sender: Sender<Piece>) {
        let mut early = pin!(self.film.ends.early(self.state.clone()));
        for index in 1..self.film.len() {
            // A slot first, so that nothing is rendered that the client does not keep up with.
            let slot = tokio::select! {
                () = &mut early => break,
                slot = timeout(self.patience, sender.reserve()) => slot,
            };
            let Ok(Ok(slot)) = slot else {
                tracing::debug!("the client has gone or takes nothing more after {index} pictures");
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
        // Whoever is gone misses nothing.
        let _ = timeout(self.patience, sender.send(Piece::End)).await;
    }

    async fn piece(&mut self, clock: &mut Option<Interval>, index: u64) -> Result<Bytes, Fault> {
        if !self.worked.is_zero() && training(&self.state).await {
            sleep(self.worked).await;
        }
        if let Some(clock) = clock {
            clock.tick().await;
        }
        let shot = self.film.shots[(index % self.film.shots.len() as u64) as usize];
        let is_last = index + 1 == self.film.len();
        let (bytes, worked) = self.maker.piece(&self.state, &mut self.place, shot, index, is_last).await?;
        self.worked = worked;
        Ok(bytes)
    }
}

/// Whether a job is being worked on; not, if the database does not tell.
async fn training(state: &AppState) -> bool {
    let running = JobFilter { states: vec![JobState::Running], ..JobFilter::default() };
    state.store().jobs(&running, None, 1).await.is_ok_and(|jobs| !jobs.is_empty())
}

impl Maker {
    /// The bytes of the next picture, and what it took to make it.
    async fn piece(
        &mut self,
        state: &AppState,
        place: &mut Place,
        shot: Shot,
        index: u64,
        is_last: bool,
    ) -> Result<(Bytes, Duration), Fault> {
        match self {
            Maker::Parts { parts, boundary } => {
                let (picture, timing) = picture(state, place, shot).await?;
                Ok((part(*parts, boundary, &picture, index, is_last), timing.worked()))
            }
            Maker::Apng(file) => {
                place.begin_picture();
                let turn = place.turn().await;
                let frame = file.take().ok_or_else(|| Fault::internal(&io::Error::other("no file")))?;
                let began = Instant::now();
                let (next, bytes) =
                    in_turn(state, turn, shot, move |rendered, _| frame.add(&rendered, is_last)).await?;
                *file = next;
                Ok((bytes, began.elapsed()))
            }
        }
    }
}

/// A part with its head. The delimiter follows it at once, because that is what makes readers show it.
fn part(parts: Parts, boundary: &str, picture: &Picture, index: u64, is_last: bool) -> Bytes {
    let mut text = String::new();
    if index == 0 {
        text.push_str(&format!("--{boundary}\r\n"));
    }
    let (media_type, length) = (picture.media_type(), picture.bytes.len());
    text.push_str(&format!("Content-Type: {media_type}\r\nContent-Length: {length}\r\n"));
    if parts == Parts::Mixed {
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
