//! How long the codec's stages take: it opens a span for each, and this listens to them.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use tracing::{Subscriber, span};
use tracing_subscriber::{Layer, layer::Context, registry::LookupSpan};

/// A stage that ended: its name below those that it was part of, as `encode/decode/masks`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Stage {
    pub(crate) path: String,
    pub(crate) time: Duration,
}

/// Collects the stages in the order in which they began.
#[derive(Clone, Default)]
pub(crate) struct Stages(Arc<Mutex<Vec<Stage>>>);

impl Stages {
    /// What was collected since the last call, stages of the same path added up.
    pub(crate) fn take(&self) -> Vec<Stage> {
        let mut merged: Vec<Stage> = Vec::new();
        for stage in std::mem::take(&mut *self.lock()) {
            match merged.iter_mut().find(|other| other.path == stage.path) {
                Some(other) => other.time += stage.time,
                None => merged.push(stage),
            }
        }
        merged
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Stage>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Place in the list, and when the stage began.
struct Begun(usize, Instant);

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Stages {
    fn on_new_span(&self, _: &span::Attributes<'_>, id: &span::Id, context: Context<'_, S>) {
        let Some(span) = context.span(id) else { return };
        let path: Vec<&str> = span.scope().from_root().map(|span| span.name()).collect();
        let mut stages = self.lock();
        stages.push(Stage { path: path.join("/"), time: Duration::ZERO });
        span.extensions_mut().insert(Begun(stages.len() - 1, Instant::now()));
    }

    fn on_close(&self, id: span::Id, context: Context<'_, S>) {
        let Some(span) = context.span(&id) else { return };
        if let Some(Begun(place, start)) = span.extensions().get::<Begun>() {
            self.lock()[*place].time = start.elapsed();
        }
    }
}
