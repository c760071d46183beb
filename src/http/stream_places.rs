//! How many streams there may be at a time: of one caller, and of all together.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use axum::http::{StatusCode, header};

use super::problem::Fault;
use crate::domain::{Caller, KeyId};

/// Seconds after which a client that found no place may try again.
const RETRY_SECONDS: u32 = 10;

/// The places; clones share them.
#[derive(Debug, Clone)]
pub(super) struct StreamPlaces(Arc<Places>);

#[derive(Debug)]
struct Places {
    all: usize,
    each: usize,
    taken: Mutex<BTreeMap<Option<KeyId>, usize>>,
}

/// A place that is held until this is dropped.
#[derive(Debug)]
pub(super) struct StreamPlace {
    places: StreamPlaces,
    key: Option<KeyId>,
}

impl StreamPlaces {
    /// So many in all, and so many of them for one key.
    pub(super) fn new(all: usize, each: usize) -> Self {
        Self(Arc::new(Places { all, each, taken: Mutex::default() }))
    }

    /// Takes a place.
    ///
    /// # Errors
    /// 429 with `Retry-After`.
    pub(super) fn take(&self, caller: &Caller) -> Result<StreamPlace, Fault> {
        let mut taken = self.lock();
        let all = taken.values().sum::<usize>();
        let own = taken.get(&caller.key).copied().unwrap_or(0);
        let (count, of) = match () {
            () if own >= self.0.each => (own, "of yours"),
            () if all >= self.0.all => (all, "in all"),
            () => {
                taken.insert(caller.key, own + 1);
                return Ok(StreamPlace { places: self.clone(), key: caller.key });
            }
        };
        Err(Fault::new(
            StatusCode::TOO_MANY_REQUESTS,
            "too-many-streams",
            "Too many streams",
            format!("{count} streams {of} are open, and there may be no more; ask for pages instead"),
        )
        .with(header::RETRY_AFTER, RETRY_SECONDS.into()))
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Option<KeyId>, usize>> {
        self.0.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for StreamPlace {
    fn drop(&mut self) {
        let mut taken = self.places.lock();
        if let Some(count) = taken.get_mut(&self.key) {
            *count -= 1;
            if *count == 0 {
                taken.remove(&self.key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn one_caller_cannot_take_the_places_of_all() {
        let places = StreamPlaces::new(3, 2);
        let [one, other] = [1, 2].map(|id| Caller { key: Some(KeyId(Uuid::from_u128(id))), admin: false });
        let (first, _second) = (places.take(&one).expect("a place"), places.take(&one).expect("a place"));
        assert!(places.take(&one).is_err(), "its share is used up");
        let third = places.take(&other).expect("a place is left for others");
        assert!(places.take(&other).is_err(), "none is left");
        drop(third);
        assert!(places.take(&one).is_err());
        drop(first);
        let _again = places.take(&one).expect("a place that was given back");
        let _other = places.take(&other).expect("a place");
        assert_eq!(places.lock().len(), 2);
    }
}
