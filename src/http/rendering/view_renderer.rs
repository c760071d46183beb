//! Renders and caches pictures; concurrent requests for the same picture render it once.
//!
//! Invariants: the cache is bounded in bytes; at most as many pictures as there are cores are encoded without a render permit; a
//! request that waits for another's render gets its result, and takes over if the other is cancelled.

use std::{
    sync::Arc,
    thread::available_parallelism,
    time::{Duration, Instant},
};

use axum::http::HeaderValue;
use quick_cache::{OptionsBuilder, Weighter, sync::Cache};
use tokio::{runtime::Handle, sync::Semaphore, task::spawn_blocking};

use super::{
    key::{RenderFrame, ViewKey},
    picture::{Output, Picture, Rendered},
    queue::{Admission, AdmissionError, QueueLimits, QueueSlot, RenderPermit, RenderQueue},
};
use crate::{
    domain::{Credential, Problem},
    http::{
        config::RequestLimits,
        meters::Meters,
        problem::{ApiResult, internal},
        services::Services,
        shared::Capacity,
    },
    render::views::{ScalarKind, Viewable},
};

/// Assumed size of a picture, for the number of cache entries.
const TYPICAL_PICTURE_BYTES: u64 = 64 << 10;
/// Memory of a cache entry beside its picture.
const ENTRY_BYTES: u64 = 256;

#[derive(Debug, Clone)]
struct Bytes;

impl Weighter<ViewKey, Picture> for Bytes {
    fn weight(&self, _: &ViewKey, picture: &Picture) -> u64 {
        picture.bytes.len() as u64 + ENTRY_BYTES
    }
}

/// The cache and the render queue; clones share them.
#[derive(Clone)]
pub(crate) struct ViewRenderer(Arc<Inner>);

struct Inner {
    services: Services,
    meters: Meters,
    queue: RenderQueue,
    cache: Cache<ViewKey, Picture, Bytes>,
    /// For pictures that are encoded while the next one is rendered.
    encoders: Arc<Semaphore>,
    encoder_count: usize,
}

/// How long the steps of a picture took.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Timing {
    cached: bool,
    queue: Duration,
    load: Duration,
    render: Duration,
    encode: Duration,
}

impl Timing {
    /// Time without waiting; zero if cached.
    pub(crate) fn render_time(&self) -> Duration {
        self.load + self.render + self.encode
    }

    /// The value of `Server-Timing`.
    pub(crate) fn header(&self) -> HeaderValue {
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

impl ViewRenderer {
    /// An empty cache and queue.
    pub(crate) fn new(limits: &RequestLimits, services: Services, meters: Meters) -> Self {
        let queue = RenderQueue::new(QueueLimits {
            at_once: limits.renders,
            requests: Capacity {
                all: limits.renders.max(1) + limits.renders_waiting,
                each: limits.renders_per_caller,
            },
            streams: Capacity { all: limits.streams, each: limits.streams_per_caller },
        });
        let mut options = OptionsBuilder::new();
        // One shard, so that a picture may be as large as the whole cache.
        options.shards(1).weight_capacity(limits.view_cache_bytes);
        options.estimated_items_capacity((limits.view_cache_bytes / TYPICAL_PICTURE_BYTES).max(16) as usize);
        let cache = match options.build() {
            Ok(options) => Cache::with_options(options, Bytes, Default::default(), Default::default()),
            Err(_) => Cache::with_weighter(16, limits.view_cache_bytes, Bytes),
        };
        let cores = available_parallelism().map_or(1, usize::from);
        let encoders = Arc::new(Semaphore::new(cores));
        Self(Arc::new(Inner { services, meters, queue, cache, encoders, encoder_count: cores }))
    }

    /// How many pictures are rendered and how many wait for a permit.
    pub(crate) fn depth(&self) -> (usize, usize) {
        self.0.queue.depth()
    }

    /// Admits a caller's request or stream.
    ///
    /// # Errors
    /// If all places are taken, or all that one caller may have.
    pub(crate) fn enter(
        &self,
        caller: Credential,
        admission: Admission,
    ) -> Result<QueueSlot, AdmissionError> {
        self.0.queue.enter(caller, admission)
    }

    /// Pictures that are encoded at a time without a render permit.
    pub(crate) fn encoders(&self) -> usize {
        self.0.encoder_count
    }

    /// The picture if it is cached.
    pub(crate) fn cached(&self, key: ViewKey) -> Option<(Picture, Timing)> {
        self.0.cache.get(&key).map(|picture| (picture, Timing { cached: true, ..Timing::default() }))
    }

    /// The picture of a frame, from the cache or rendered with a permit. Calls `on_rendered` before it encodes the picture.
    ///
    /// # Errors
    /// If the scene cannot be loaded or rendered, or the picture not encoded.
    pub(crate) async fn picture(
        &self,
        slot: &QueueSlot,
        frame: RenderFrame,
        on_rendered: impl FnOnce() + Send + 'static,
    ) -> ApiResult<(Picture, Timing)> {
        let (key, kind) = (frame.key(), frame.spec.kind);
        slot.begin_picture();
        let entered = Instant::now();
        let vacant = match self.0.cache.get_value_or_guard_async(&key).await {
            Ok(picture) => return Ok((picture, Timing { cached: true, ..Timing::default() })),
            Err(vacant) => vacant,
        };
        let permit = slot.permit().await;
        let queue = entered.elapsed();
        let made = self.render_with_permit(permit, frame, move |rendered, timing| {
            on_rendered();
            let started = Instant::now();
            let picture = Picture::encode(&rendered, kind).map_err(|error| failed(&error))?;
            Ok((picture, Timing { queue, encode: started.elapsed(), ..timing }))
        });
        let (picture, timing) = made.await?;
        // Fails only if another has inserted it meanwhile.
        let _ = vacant.insert(picture.clone());
        Ok((picture, timing))
    }

    /// Renders and finishes a frame on a blocking thread, even if the request is cancelled. It gives the permit back once the frame is
    /// rendered, or at its end if as many others are being finished as there are cores.
    async fn render_with_permit<T: Send + 'static>(
        &self,
        permit: RenderPermit,
        frame: RenderFrame,
        finish: impl FnOnce(Rendered, Timing) -> Result<T, Problem> + Send + 'static,
    ) -> ApiResult<T> {
        let this = self.clone();
        let runtime = Handle::current();
        let span = tracing::Span::current();
        let made = spawn_blocking(move || {
            let _span = span.entered();
            let Inner { services, meters, encoders, .. } = &*this.0;
            let (rendered, timing) = render(services, &runtime, &frame)?;
            meters.rendered(timing.render);
            let encoder = Arc::clone(encoders).try_acquire_owned();
            // Dropped here if there is room to encode.
            let _permit = encoder.is_err().then_some(permit);
            finish(rendered, timing)
        });
        Ok(made.await??)
    }
}

fn render(services: &Services, runtime: &Handle, frame: &RenderFrame) -> Result<(Rendered, Timing), Problem> {
    let RenderFrame { spec, renderer } = frame;
    let loaded = std::cell::Cell::new(Duration::ZERO);
    let load = || -> Result<Viewable, Problem> {
        let started = Instant::now();
        let viewable =
            services.read(runtime, spec.artifact).and_then(|content| services.engine.load(&content));
        loaded.set(loaded.get() + started.elapsed());
        viewable
    };
    let plane = |kind| renderer.render_scalars(spec.artifact, &load, &spec.camera, kind);
    let started = Instant::now();
    let rendered = match spec.kind.output {
        Output::Color => Rendered::Color(renderer.render(spec.artifact, &load, &spec.camera)?),
        Output::Depth => Rendered::Depth(plane(ScalarKind::Depth)?),
        Output::Alpha => Rendered::Alpha(plane(ScalarKind::Alpha)?),
    };
    let render = started.elapsed().saturating_sub(loaded.get());
    Ok((rendered, Timing { load: loaded.get(), render, ..Timing::default() }))
}

/// An internal problem; the error goes to the log.
pub(crate) fn failed(error: &(dyn std::error::Error + 'static)) -> Problem {
    tracing::error!(error, "a view cannot be made: {error}");
    internal()
}
