//! Who renders when: a bounded line before few renders at a time, which takes callers in turn.
//!
//! A request enters once and then takes a turn for each picture, so a long batch stands in line again after each of its
//! pictures, behind whoever came meanwhile. Among those who wait, callers are served one after another, whatever each
//! has asked for. What always holds: no more turns are out than [`Bounds::at_once`]; whoever stops waiting leaves the line
//! at once.

use std::{
    collections::{HashMap, VecDeque},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use axum::http::{StatusCode, header};
use tokio::sync::oneshot;

use crate::{domain::KeyId, http::problem::Fault};

/// What a picture is taken to need before any was made.
const FIRST_GUESS: Duration = Duration::from_millis(500);
/// How far a new duration moves the mean.
const MEAN_WEIGHT: f64 = 0.2;
/// Longest advice to come back, in seconds.
const LONGEST_ADVICE: f64 = 120.0;

/// How much a [`RenderQueue`] bears.
#[derive(Debug, Clone, Copy)]
pub(in crate::http) struct Bounds {
    /// Pictures rendered at a time.
    pub(in crate::http) at_once: usize,
    /// Requests that are rendered or wait.
    pub(in crate::http) requests: Room,
    /// Streams, which stay for long and wait between pictures.
    pub(in crate::http) streams: Room,
}

/// How many are let in.
#[derive(Debug, Clone, Copy)]
pub(in crate::http) struct Room {
    /// Of all callers together.
    pub(in crate::http) all: usize,
    /// Of one caller.
    pub(in crate::http) each: usize,
}

/// What enters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Visit {
    /// A request for so many pictures.
    Request(usize),
    /// A stream.
    Stream,
}

/// Not let in, with the seconds after which there may be room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refused {
    /// All places are taken.
    Full(Visit, u64),
    /// The caller has its share of them.
    OverShare(Visit, u64),
}

impl From<Refused> for Fault {
    fn from(refused: Refused) -> Self {
        let waiting = |visit| match visit {
            Visit::Request(_) => "views are waiting to be rendered",
            Visit::Stream => "streams of views are open",
        };
        let (fault, seconds) = match refused {
            Refused::Full(visit, seconds) => {
                let detail = format!("too many {}", waiting(visit));
                (Fault::new(StatusCode::SERVICE_UNAVAILABLE, "busy", "Busy", detail), seconds)
            }
            Refused::OverShare(visit, seconds) => {
                let detail = format!("too many of this caller's {}", waiting(visit));
                (
                    Fault::new(StatusCode::TOO_MANY_REQUESTS, "too-many-views", "Too many views", detail),
                    seconds,
                )
            }
        };
        fault.with(header::RETRY_AFTER, seconds.into())
    }
}

/// The line; clones share it.
#[derive(Debug, Clone)]
pub(in crate::http) struct RenderQueue(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    bounds: Bounds,
    line: Mutex<Line>,
}

type Who = Option<KeyId>;

#[derive(Debug, Default)]
struct Line {
    /// Turns that are out.
    turns: usize,
    requests: Inside,
    streams: Inside,
    /// Pictures that those inside have not yet asked a turn for.
    to_come: usize,
    /// Callers with somebody waiting; the first is served next.
    lanes: VecDeque<Lane>,
    tickets: u64,
    mean_seconds: Option<f64>,
}

#[derive(Debug, Default)]
struct Inside {
    all: usize,
    each: HashMap<Who, usize>,
}

impl Inside {
    fn of(&self, who: Who) -> usize {
        self.each.get(&who).copied().unwrap_or(0)
    }

    fn enter(&mut self, who: Who) {
        self.all += 1;
        *self.each.entry(who).or_default() += 1;
    }

    fn leave(&mut self, who: Who) {
        self.all -= 1;
        if let Some(count) = self.each.get_mut(&who) {
            *count -= 1;
            if *count == 0 {
                self.each.remove(&who);
            }
        }
    }
}

#[derive(Debug)]
struct Lane {
    who: Who,
    waiting: VecDeque<(u64, oneshot::Sender<()>)>,
}

impl Line {
    fn wait(&mut self, who: Who) -> (u64, oneshot::Receiver<()>) {
        let (sender, receiver) = oneshot::channel();
        self.tickets += 1;
        let entry = (self.tickets, sender);
        match self.lanes.iter_mut().find(|lane| lane.who == who) {
            Some(lane) => lane.waiting.push_back(entry),
            None => self.lanes.push_back(Lane { who, waiting: [entry].into() }),
        }
        (self.tickets, receiver)
    }

    /// Whether the ticket was still waiting.
    fn give_up(&mut self, who: Who, ticket: u64) -> bool {
        let Some(place) = self.lanes.iter().position(|lane| lane.who == who) else { return false };
        let lane = &mut self.lanes[place].waiting;
        let before = lane.len();
        lane.retain(|(waiting, _)| *waiting != ticket);
        let found = lane.len() < before;
        if lane.is_empty() {
            self.lanes.remove(place);
        }
        found
    }

    fn give_turns(&mut self, at_once: usize) {
        while self.turns < at_once {
            let Some(mut lane) = self.lanes.pop_front() else { return };
            let next = lane.waiting.pop_front();
            if !lane.waiting.is_empty() {
                self.lanes.push_back(lane);
            }
            // Whoever went away has left the line, so somebody is there to take it.
            if next.is_some_and(|(_, sender)| sender.send(()).is_ok()) {
                self.turns += 1;
            }
        }
    }

    /// Seconds until `pictures` are done.
    fn advice(&self, pictures: usize, at_once: usize) -> u64 {
        let mean = self.mean_seconds.unwrap_or(FIRST_GUESS.as_secs_f64());
        (pictures as f64 * mean / at_once as f64).ceil().clamp(1.0, LONGEST_ADVICE) as u64
    }
}

impl Shared {
    fn line(&self) -> MutexGuard<'_, Line> {
        self.line.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn end_turn(&self, line: &mut Line) {
        line.turns -= 1;
        line.give_turns(self.bounds.at_once);
    }
}

impl RenderQueue {
    /// An empty line.
    pub(in crate::http) fn new(bounds: Bounds) -> Self {
        let bounds = Bounds { at_once: bounds.at_once.max(1), ..bounds };
        Self(Arc::new(Shared { bounds, line: Mutex::default() }))
    }

    /// How many pictures are rendered and how many wait for their turn.
    pub(super) fn depth(&self) -> (usize, usize) {
        let line = self.0.line();
        (line.turns, line.lanes.iter().map(|lane| lane.waiting.len()).sum())
    }

    /// Lets a caller's request or stream in.
    pub(super) fn enter(&self, who: Who, visit: Visit) -> Result<Place, Refused> {
        let Bounds { at_once, requests, streams } = self.0.bounds;
        let mut line = self.0.line();
        let waiting = line.lanes.iter().map(|lane| lane.waiting.len()).sum::<usize>();
        let ahead = line.turns + waiting + line.to_come;
        let (inside, room, pictures) = match visit {
            Visit::Request(pictures) => (&line.requests, requests, pictures),
            Visit::Stream => (&line.streams, streams, 0),
        };
        if inside.all >= room.all {
            return Err(Refused::Full(visit, line.advice(ahead, at_once)));
        }
        if inside.of(who) >= room.each {
            return Err(Refused::OverShare(visit, line.advice(ahead, at_once)));
        }
        match visit {
            Visit::Request(_) => line.requests.enter(who),
            Visit::Stream => line.streams.enter(who),
        }
        line.to_come += pictures;
        Ok(Place { shared: Arc::clone(&self.0), who, visit, to_come: pictures })
    }
}

/// A request or stream inside; it leaves when this is dropped.
#[derive(Debug)]
pub(super) struct Place {
    shared: Arc<Shared>,
    who: Who,
    visit: Visit,
    to_come: usize,
}

impl Place {
    /// One of the pictures that it came for is dealt with from now on, with a turn or without.
    pub(super) fn begin_picture(&mut self) {
        if self.to_come > 0 {
            self.to_come -= 1;
            self.shared.line().to_come -= 1;
        }
    }

    /// Waits for a turn to render one picture.
    pub(super) async fn turn(&self) -> Turn {
        let (ticket, granted) = {
            let mut line = self.shared.line();
            let entry = line.wait(self.who);
            line.give_turns(self.shared.bounds.at_once);
            entry
        };
        let waiting = Waiting { shared: Arc::clone(&self.shared), who: self.who, ticket, granted: false };
        // The other end stays in the line until it is used.
        let _ = granted.await;
        waiting.granted()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut line = self.shared.line();
        line.to_come -= self.to_come;
        match self.visit {
            Visit::Request(_) => line.requests.leave(self.who),
            Visit::Stream => line.streams.leave(self.who),
        }
    }
}

/// Somebody in line.
struct Waiting {
    shared: Arc<Shared>,
    who: Who,
    ticket: u64,
    granted: bool,
}

impl Waiting {
    fn granted(mut self) -> Turn {
        self.granted = true;
        Turn { shared: Arc::clone(&self.shared), since: Instant::now() }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        if self.granted {
            return;
        }
        let mut line = self.shared.line();
        if !line.give_up(self.who, self.ticket) {
            // The turn came while its taker was going away.
            self.shared.end_turn(&mut line);
        }
    }
}

/// Leave to render; the next one's when this is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    shared: Arc<Shared>,
    since: Instant,
}

impl Drop for Turn {
    fn drop(&mut self) {
        let seconds = self.since.elapsed().as_secs_f64();
        let mut line = self.shared.line();
        line.mean_seconds =
            Some(line.mean_seconds.map_or(seconds, |mean| mean + MEAN_WEIGHT * (seconds - mean)));
        self.shared.end_turn(&mut line);
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt as _, future::LocalBoxFuture};
    use uuid::Uuid;

    use super::*;

    fn key(id: u128) -> Who {
        Some(KeyId(Uuid::from_u128(id)))
    }

    fn queue(at_once: usize, all: usize, each: usize) -> RenderQueue {
        let room = Room { all, each };
        RenderQueue::new(Bounds { at_once, requests: room, streams: room })
    }

    /// Turns asked for, first poll included, so that all stand in line in this order.
    fn line_up<'a>(places: &'a [Place]) -> Vec<LocalBoxFuture<'a, Turn>> {
        places
            .iter()
            .map(|place| {
                let mut turn = place.turn().boxed_local();
                assert!(turn.as_mut().now_or_never().is_none(), "somebody has the turn");
                turn
            })
            .collect()
    }

    #[test]
    fn callers_are_served_in_turn_whatever_each_has_asked_for() {
        let queue = queue(1, 10, 10);
        let first = queue.enter(key(9), Visit::Request(1)).expect("room");
        let mut running = first.turn().now_or_never();
        assert!(running.is_some());
        let callers = [1, 1, 1, 2, 3, 2];
        let places: Vec<Place> =
            callers.iter().map(|id| queue.enter(key(*id), Visit::Request(1)).expect("room")).collect();
        let mut waiting: Vec<_> = line_up(&places).into_iter().map(Some).collect();
        let mut served = Vec::new();
        while served.len() < callers.len() {
            running = None;
            for (index, turn) in waiting.iter_mut().enumerate() {
                if let Some(future) = turn
                    && let Some(granted) = future.as_mut().now_or_never()
                {
                    assert!(running.is_none(), "one at a time");
                    running = Some(granted);
                    served.push(callers[index]);
                    *turn = None;
                }
            }
            assert!(running.is_some(), "somebody is served");
        }
        assert_eq!(served, [1, 2, 3, 1, 2, 1]);
    }

    #[test]
    fn the_whole_and_each_caller_are_bounded_and_told_when_to_come_back() {
        let queue = queue(2, 3, 2);
        let enter = |id| queue.enter(key(id), Visit::Request(10));
        let kept = [enter(1).expect("room"), enter(1).expect("room")];
        assert!(
            matches!(enter(1), Err(Refused::OverShare(_, 5))),
            "twenty pictures of half a second, two at a time"
        );
        let other = enter(2).expect("room");
        assert!(matches!(enter(3), Err(Refused::Full(_, 8))));
        let _stream = queue.enter(key(1), Visit::Stream).expect("streams have room of their own");
        drop(kept);
        enter(1).expect("room again");
        drop(other);
        assert_eq!(queue.0.line().to_come, 0);
    }

    #[test]
    fn whoever_goes_away_leaves_the_line_and_a_turn_on_its_way_is_passed_on() {
        let queue = queue(1, 10, 10);
        let places: Vec<Place> =
            (0..4).map(|id| queue.enter(key(id), Visit::Request(1)).expect("room")).collect();
        let running = places[0].turn().now_or_never().expect("nobody else");
        let mut waiting = line_up(&places[1..]);
        drop(waiting.remove(0));
        drop(running);
        // The turn is the second's now, who goes without having taken it.
        drop(waiting.remove(0));
        let last = waiting.remove(0).now_or_never();
        assert!(last.is_some());
        drop(last);
        let line = queue.0.line();
        assert_eq!((line.turns, line.lanes.len()), (0, 0));
        assert!(line.mean_seconds.is_some());
    }
}
