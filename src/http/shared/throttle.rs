//! Rate limits: requests per key, and failed authentications per address.
//!
//! Both are token buckets that refill evenly over a minute (GCRA, by `governor`), in monotonic time: a clock that is set changes no wait.
//! The tables are bounded, one by the number of keys, the other by [`MAX_ADDRESSES`].

use std::{
    collections::HashMap,
    fmt,
    net::{IpAddr, Ipv4Addr},
    num::NonZeroU32,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use governor::{
    NotUntil, Quota, RateLimiter,
    clock::Clock as _,
    middleware::NoOpMiddleware,
    nanos::Nanos,
    state::{InMemoryState, NotKeyed, keyed::HashMapStateStore},
};

use crate::{
    domain::{Clock, KeyId},
    http::{client_address::ClientAddress, config::AccessRules},
    store::KeyRecord,
};

/// Addresses with a bucket of their own; once there are more, new ones share one.
const MAX_ADDRESSES: usize = 10_000;
/// How old the recorded last use of a key may become.
const TOUCH_EVERY: Duration = Duration::from_secs(60);

/// The service's monotonic time, as `governor` reads it.
#[derive(Clone)]
struct Ticks(Arc<dyn Clock>);

impl governor::clock::Clock for Ticks {
    type Instant = Nanos;

    fn now(&self) -> Nanos {
        u64::try_from(self.0.elapsed().as_nanos()).unwrap_or(u64::MAX).into()
    }
}

type Limiter = RateLimiter<NotKeyed, InMemoryState, Ticks, NoOpMiddleware<Nanos>>;
type PerAddress = RateLimiter<IpAddr, HashMapStateStore<IpAddr>, Ticks, NoOpMiddleware<Nanos>>;

/// The bucket of one key, and when its use was last recorded.
struct Use {
    limit: Option<(NonZeroU32, Arc<Limiter>)>,
    /// In monotonic time.
    touched_at: Option<Duration>,
}

/// How long until the next request is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Wait(Duration);

impl Wait {
    /// For `Retry-After`: whole seconds, at least one.
    pub(crate) fn seconds(self) -> u64 {
        let whole = self.0.as_secs() + u64::from(self.0.subsec_nanos() > 0);
        whole.max(1)
    }
}

/// The buckets.
pub(crate) struct Throttle {
    ticks: Ticks,
    rules: AccessRules,
    uses: Mutex<HashMap<KeyId, Use>>,
    failures: PerAddress,
}

impl fmt::Debug for Throttle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Throttle").field("rules", &self.rules).finish_non_exhaustive()
    }
}

impl Throttle {
    pub(crate) fn new(clock: Arc<dyn Clock>, rules: AccessRules) -> Self {
        let ticks = Ticks(clock);
        let quota = Quota::per_minute(rules.failures_per_minute);
        let failures = RateLimiter::hashmap_with_clock(quota, ticks.clone());
        Self { ticks, rules, uses: Mutex::default(), failures }
    }

    /// Counts a request of a key.
    pub(crate) fn request(&self, key: &KeyRecord) -> Result<(), Wait> {
        let Some(rate) = key.requests_per_minute.or(self.rules.requests_per_minute) else {
            return Ok(());
        };
        let limiter = {
            let mut uses = self.uses.lock().unwrap_or_else(PoisonError::into_inner);
            let entry = uses.entry(key.id).or_insert_with(Use::none);
            match &entry.limit {
                Some((known, limiter)) if *known == rate => Arc::clone(limiter),
                _ => {
                    let quota = Quota::per_minute(rate);
                    let limiter = Arc::new(RateLimiter::direct_with_clock(quota, self.ticks.clone()));
                    entry.limit = Some((rate, Arc::clone(&limiter)));
                    limiter
                }
            }
        };
        limiter.check().map_err(|until| self.wait(&until))
    }

    /// Counts a request that came without a good key.
    pub(crate) fn failure(&self, address: Option<ClientAddress>) -> Result<(), Wait> {
        let mut network = address.map_or(IpAddr::V4(Ipv4Addr::UNSPECIFIED), ClientAddress::network);
        if self.failures.len() >= MAX_ADDRESSES {
            self.failures.retain_recent();
            if self.failures.len() >= MAX_ADDRESSES {
                network = Ipv4Addr::UNSPECIFIED.into();
            }
        }
        self.failures.check_key(&network).map_err(|until| self.wait(&until))
    }

    /// Whether the use of a key should be recorded now; true once in [`TOUCH_EVERY`].
    pub(crate) fn is_due(&self, key: &KeyRecord) -> bool {
        let (now, elapsed) = (self.ticks.0.now(), self.ticks.0.elapsed());
        let mut uses = self.uses.lock().unwrap_or_else(PoisonError::into_inner);
        let entry = uses.entry(key.id).or_insert_with(Use::none);
        // The record has the database's time, which may be far from this machine's, so it decides only until the first touch.
        let due = match (entry.touched_at, key.last_used_at) {
            (Some(touched), _) => elapsed.saturating_sub(touched) >= TOUCH_EVERY,
            (None, Some(used)) => now.duration_since(used).unsigned_abs() >= TOUCH_EVERY,
            (None, None) => true,
        };
        if due {
            entry.touched_at = Some(elapsed);
        }
        due
    }

    fn wait(&self, until: &NotUntil<Nanos>) -> Wait {
        Wait(until.wait_time_from(self.ticks.now()))
    }
}

impl Use {
    fn none() -> Self {
        Self { limit: None, touched_at: None }
    }
}

#[cfg(test)]
mod tests {
    use jiff::{SignedDuration, Timestamp};
    use uuid::Uuid;

    use super::*;
    use crate::domain::{ManualClock, ProjectId};

    fn throttle(rules: AccessRules) -> (Throttle, Arc<ManualClock>) {
        let clock = Arc::new(ManualClock::new("2026-11-21T00:00:00Z".parse().expect("an instant")));
        (Throttle::new(clock.clone(), rules), clock)
    }

    fn key(id: u128, per_minute: Option<u32>) -> KeyRecord {
        KeyRecord {
            id: KeyId(Uuid::from_u128(id)),
            name: "a key".into(),
            prefix: "tcgs_".into(),
            scopes: Vec::new(),
            project_id: ProjectId::DEFAULT,
            requests_per_minute: per_minute.and_then(NonZeroU32::new),
            expires_at: None,
            created_at: Timestamp::UNIX_EPOCH,
            last_used_at: None,
            revoked_at: None,
        }
    }

    #[test]
    fn a_key_has_its_requests_a_minute_and_gets_them_back_evenly() {
        let (throttle, clock) = throttle(AccessRules::default());
        let (one, other) = (key(1, Some(3)), key(2, Some(3)));
        for _ in 0..3 {
            assert_eq!(throttle.request(&one), Ok(()));
        }
        assert_eq!(throttle.request(&one).map_err(Wait::seconds), Err(20));
        assert_eq!(throttle.request(&other), Ok(()), "keys do not share a bucket");
        clock.advance(SignedDuration::from_millis(1_500));
        assert_eq!(throttle.request(&one).map_err(Wait::seconds), Err(19), "18.5 s would be too soon");
        clock.advance(SignedDuration::from_millis(18_000));
        assert_eq!(throttle.request(&one).map_err(Wait::seconds), Err(1));
        clock.advance(SignedDuration::from_millis(500));
        assert_eq!(throttle.request(&one), Ok(()));
        assert!(throttle.request(&one).is_err());
    }

    #[test]
    fn a_key_without_a_rate_has_the_services_or_none() {
        let (free, _) = throttle(AccessRules::default());
        assert!((0..10_000).all(|_| free.request(&key(1, None)).is_ok()));
        let rules = AccessRules { requests_per_minute: NonZeroU32::new(2), ..AccessRules::default() };
        let (bounded, _) = throttle(rules);
        let taken = (0..10).filter(|_| bounded.request(&key(1, None)).is_ok()).count();
        assert_eq!(taken, 2);
        let taken = (0..10).filter(|_| bounded.request(&key(2, Some(5))).is_ok()).count();
        assert_eq!(taken, 5, "a key's own rate goes first");
        assert_eq!(bounded.request(&key(2, Some(7))), Ok(()), "a rate that is changed holds at once");
    }

    #[test]
    fn failures_are_counted_by_address_in_a_bounded_table() {
        let rules = AccessRules { failures_per_minute: NonZeroU32::MIN, ..AccessRules::default() };
        let (throttle, clock) = throttle(rules);
        let address = |n: u32| Some(ClientAddress(Ipv4Addr::from_bits(n).into()));
        assert_eq!(throttle.failure(address(1)), Ok(()));
        assert_eq!(throttle.failure(address(1)).map_err(Wait::seconds), Err(60));
        for n in 0..MAX_ADDRESSES as u32 {
            let _ = throttle.failure(address(1000 + n));
        }
        assert_eq!(throttle.failures.len(), MAX_ADDRESSES + 1, "the shared bucket is one more");
        let _ = throttle.failure(address(5));
        assert!(throttle.failure(address(6)).is_err(), "beyond the bound, addresses share a bucket");
        assert_eq!(throttle.failures.len(), MAX_ADDRESSES + 1);
        clock.advance(SignedDuration::from_secs(120));
        assert_eq!(throttle.failure(address(6)), Ok(()));
        assert!(throttle.failures.len() < 10, "what is long over is forgotten");
    }

    #[test]
    fn the_use_of_a_key_is_recorded_once_a_minute() {
        let (throttle, clock) = throttle(AccessRules::default());
        let key = key(1, None);
        assert!(throttle.is_due(&key));
        assert!(!throttle.is_due(&key));
        clock.advance(SignedDuration::from_secs(61));
        assert!(throttle.is_due(&key));
        assert!(!throttle.is_due(&key));
    }

    #[test]
    fn a_clock_that_is_set_or_differs_from_the_databases_does_not_make_every_request_a_write() {
        let (throttle, clock) = throttle(AccessRules::default());
        let used_at = |at| KeyRecord { last_used_at: Some(at), ..key(1, None) };
        let ahead = clock.now() + SignedDuration::from_mins(2);
        assert!(throttle.is_due(&used_at(ahead)), "once for each start");
        assert!(!throttle.is_due(&used_at(ahead)));
        clock.advance(SignedDuration::from_secs(61));
        assert!(throttle.is_due(&used_at(ahead)));
        clock.set_by(-SignedDuration::from_hours(1));
        assert!(!throttle.is_due(&used_at(ahead)));
        clock.advance(SignedDuration::from_secs(61));
        assert!(throttle.is_due(&used_at(ahead)));
        assert!(!throttle.is_due(&used_at(ahead)));
    }

    #[test]
    fn a_use_that_another_process_has_just_recorded_is_not_recorded_again() {
        let (throttle, clock) = throttle(AccessRules::default());
        let used = KeyRecord { last_used_at: Some(clock.now()), ..key(1, None) };
        assert!(!throttle.is_due(&used));
        clock.advance(SignedDuration::from_secs(61));
        assert!(throttle.is_due(&used));
    }
}
