//! Where pictures are made: from the cache if they are there, else in turn, once however many ask.
//!
//! What always holds: the cache is bounded in bytes; whoever waits for a picture that another renders gets it when it is
//! done, and takes over if the other goes away.

use std::time::{Duration, Instant};

use axum::http::HeaderValue;
use quick_cache::{OptionsBuilder, Weighter, sync::Cache};
use tokio::{runtime::Handle, task::spawn_blocking};

use super::{
    key::{Key, Shot},
    queue::{Bounds, Place, RenderQueue, Room, Turn},
};
use crate::{
    domain::Problem,
    http::{
        config::RequestLimits,
        picture::{Output, Picture, Rendered},
        problem::{Fault, internal},
        state::{AppState, Services},
    },
    render::views::{ScalarKind, Viewable},
};

/// Size that a picture is taken to have, to size the cache's table.
const USUAL_BYTES: u64 = 64 << 10;
/// What an entry takes beside its picture.
const ENTRY_BYTES: u64 = 256;

#[derive(Debug, Clone)]
struct Bytes;

impl Weighter<Key, Picture> for Bytes {
    fn weight(&self, _: &Key, picture: &Picture) -> u64 {
        picture.bytes.len() as u64 + ENTRY_BYTES
    }
}

/// The cache, the line before the renderer, and the renderer's name.
#[derive(Debug)]
pub(in crate::http) struct Studio {
    pub(super) queue: RenderQueue,
    identity: String,
    cache: Cache<Key, Picture, Bytes>,
}

/// Where the time of a picture went.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Timing {
    cached: bool,
    queue: Duration,
    load: Duration,
    render: Duration,
    encode: Duration,
}

impl Timing {
    /// What making it took, without waiting; nothing if it was at hand.
    pub(super) fn worked(&self) -> Duration {
        self.load + self.render + self.encode
    }

    /// The value of `Server-Timing`.
    pub(super) fn header(&self) -> HeaderValue {
        if self.cached {
            return HeaderValue::from_static("cache;desc=hit");
        }
        let milliseconds = |duration: Duration| duration.as_secs_f64() * 1e3;
        let text = format!(
            "cache;desc=miss, queue;dur={:.1}, load;dur={:.1}, render;dur={:.1}, encode;dur={:.1}",
            milliseconds(self.queue),
            milliseconds(self.load),
            milliseconds(self.render),
            milliseconds(self.encode),
        );
        HeaderValue::try_from(text).unwrap_or(HeaderValue::from_static("cache;desc=miss"))
    }
}

impl Studio {
    /// An empty cache and an empty line.
    pub(in crate::http) fn new(services: &Services, limits: &RequestLimits) -> Self {
        let queue = RenderQueue::new(Bounds {
            at_once: limits.renders,
            requests: Room { all: limits.renders.max(1) + limits.renders_waiting, each: limits.renders_each },
            streams: Room { all: limits.streams, each: limits.streams_each },
        });
        let mut options = OptionsBuilder::new();
        // One shard, so that the largest picture that is kept is as large as the cache, not as a part of it.
        options.shards(1).weight_capacity(limits.view_cache_bytes);
        options.estimated_items_capacity((limits.view_cache_bytes / USUAL_BYTES).max(16) as usize);
        let cache = match options.build() {
            Ok(options) => Cache::with_options(options, Bytes, Default::default(), Default::default()),
            Err(_) => Cache::with_weighter(16, limits.view_cache_bytes, Bytes),
        };
        Self { queue, identity: services.renderer.identity(), cache }
    }

    /// How many pictures are rendered and how many wait for their turn.
    pub(in crate::http) fn depth(&self) -> (usize, usize) {
        self.queue.depth()
    }

    /// The key of a shot.
    pub(super) fn key(&self, shot: &Shot) -> Key {
        Key::new(&self.identity, shot)
    }

    /// The picture if it was made before.
    pub(super) fn at_hand(&self, key: Key) -> Option<(Picture, Timing)> {
        self.cache.get(&key).map(|picture| (picture, Timing { cached: true, ..Timing::default() }))
    }
}

/// The picture of a shot, made in turn unless it is at hand.
pub(super) async fn picture(
    state: &AppState,
    place: &mut Place,
    shot: Shot,
) -> Result<(Picture, Timing), Fault> {
    let studio = state.studio();
    let key = studio.key(&shot);
    place.begin_picture();
    let entered = Instant::now();
    let vacant = match studio.cache.get_value_or_guard_async(&key).await {
        Ok(picture) => return Ok((picture, Timing { cached: true, ..Timing::default() })),
        Err(vacant) => vacant,
    };
    let turn = place.turn().await;
    let queue = entered.elapsed();
    let made = in_turn(state, turn, shot, move |rendered, timing| {
        let began = Instant::now();
        let picture = Picture::encode(&rendered, shot.kind).map_err(|error| failed(&error))?;
        Ok((picture, Timing { queue, encode: began.elapsed(), ..timing }))
    });
    let (picture, timing) = made.await?;
    // Refused only if it was put there meanwhile, and then it is there.
    let _ = vacant.insert(picture.clone());
    Ok((picture, timing))
}

/// Renders a shot on a blocking thread and finishes it there; the turn ends with that, whether or not anybody still waits.
pub(super) async fn in_turn<T: Send + 'static>(
    state: &AppState,
    turn: Turn,
    shot: Shot,
    finish: impl FnOnce(Rendered, Timing) -> Result<T, Problem> + Send + 'static,
) -> Result<T, Fault> {
    let state = state.clone();
    let runtime = Handle::current();
    let span = tracing::Span::current();
    let made = spawn_blocking(move || {
        let _span = span.entered();
        let _turn = turn;
        let (rendered, timing) = render(state.services(), &runtime, &shot)?;
        state.meters().rendered(timing.render);
        finish(rendered, timing)
    });
    Ok(made.await.map_err(|error| Fault::internal(&error))??)
}

fn render(services: &Services, runtime: &Handle, shot: &Shot) -> Result<(Rendered, Timing), Problem> {
    let loaded = std::cell::Cell::new(Duration::ZERO);
    let load = || -> Result<Viewable, Problem> {
        let began = Instant::now();
        let content = runtime.block_on(services.blobs.read(shot.artifact)).map_err(|error| failed(&error))?;
        let viewable = (services.load)(&content);
        loaded.set(loaded.get() + began.elapsed());
        viewable
    };
    let (renderer, camera) = (&services.renderer, &shot.camera);
    let plane = |kind| renderer.render_scalars(shot.artifact, &load, camera, kind);
    let began = Instant::now();
    let rendered = match shot.kind.output {
        Output::Color => Rendered::Color(renderer.render(shot.artifact, &load, camera)?),
        Output::Depth => Rendered::Depth(plane(ScalarKind::Depth)?),
        Output::Alpha => Rendered::Alpha(plane(ScalarKind::Alpha)?),
    };
    let render = began.elapsed().saturating_sub(loaded.get());
    Ok((rendered, Timing { load: loaded.get(), render, ..Timing::default() }))
}

/// The problem of a fault that is the server's own, which goes to the log.
pub(super) fn failed(error: &(dyn std::error::Error + 'static)) -> Problem {
    tracing::error!(error, "a view cannot be made: {error}");
    internal()
}
