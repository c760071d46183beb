//! The time, from an injected [`Clock`], so that tests control it.

use std::{
    sync::{LazyLock, Mutex, PoisonError},
    time::{Duration, Instant},
};

use jiff::{SignedDuration, Timestamp};

/// A source of the current time.
pub trait Clock: Send + Sync + 'static {
    /// The current instant.
    fn now(&self) -> Timestamp;

    /// Monotonic time since some moment in the life of this process.
    fn elapsed(&self) -> Duration;
}

/// The start of [`SystemClock::elapsed`].
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

/// A clock that moves only when a test moves it.
#[derive(Debug)]
pub struct ManualClock(Mutex<Reading>);

#[derive(Debug, Clone, Copy)]
struct Reading {
    now: Timestamp,
    elapsed: Duration,
}

impl ManualClock {
    /// A clock that is stopped at `start`.
    #[must_use]
    pub fn new(start: Timestamp) -> Self {
        Self(Mutex::new(Reading { now: start, elapsed: Duration::ZERO }))
    }

    /// Advances time; a negative duration does nothing.
    pub fn advance(&self, by: SignedDuration) {
        self.set_by(by);
        let mut reading = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        reading.elapsed += Duration::try_from(by).unwrap_or_default();
    }

    /// Sets the clock without advancing monotonic time.
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
