//! Time is asked of a [`Clock`] that the caller hands in, so tests decide what time it is.

use std::{
    sync::{LazyLock, Mutex, PoisonError},
    time::{Duration, Instant},
};

use jiff::{SignedDuration, Timestamp};

/// A source of the current time.
pub trait Clock: Send + Sync + 'static {
    /// The current instant.
    fn now(&self) -> Timestamp;

    /// Time since some moment in the life of this process, which setting the clock does not change.
    fn elapsed(&self) -> Duration;
}

/// The moment that [`SystemClock::elapsed`] counts from.
static BEGIN: LazyLock<Instant> = LazyLock::new(Instant::now);

/// The machine's clock.
#[derive(Debug, Clone, Copy, Default)]
pub struct SystemClock;

impl Clock for SystemClock {
    #[expect(clippy::disallowed_methods, reason = "this is the one place that asks the machine for the time")]
    fn now(&self) -> Timestamp {
        Timestamp::now()
    }

    fn elapsed(&self) -> Duration {
        BEGIN.elapsed()
    }
}

/// A clock that moves only when told to.
#[derive(Debug)]
pub struct ManualClock(Mutex<Reading>);

#[derive(Debug, Clone, Copy)]
struct Reading {
    now: Timestamp,
    elapsed: Duration,
}

impl ManualClock {
    /// A clock that stands at `start`.
    #[must_use]
    pub fn new(start: Timestamp) -> Self {
        Self(Mutex::new(Reading { now: start, elapsed: Duration::ZERO }))
    }

    /// Lets time pass; none passes by less than nothing.
    pub fn advance(&self, by: SignedDuration) {
        self.set_by(by);
        let mut reading = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        reading.elapsed += Duration::try_from(by).unwrap_or_default();
    }

    /// Sets the clock forward or back, in no time.
    pub fn set_by(&self, by: SignedDuration) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).now += by;
    }

    fn read(&self) -> Reading {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Clock for ManualClock {
    fn now(&self) -> Timestamp {
        self.read().now
    }

    fn elapsed(&self) -> Duration {
        self.read().elapsed
    }
}
