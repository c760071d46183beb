//! Counted places, with a limit on all together and on those of one holder.

use std::{
    collections::HashMap,
    hash::Hash,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

/// How many places there are.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Capacity {
    /// For all holders together.
    pub(crate) all: usize,
    /// For one holder.
    pub(crate) each: usize,
}

impl Capacity {
    /// Places of which one holder leaves a quarter, or at least one, to the others where there is more than one.
    pub(crate) fn shared(all: usize) -> Self {
        Self { all, each: (all - all.div_ceil(4)).max(1) }
    }
}

/// How many places are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Taken {
    pub(crate) by_all: usize,
    pub(crate) by_holder: usize,
}

/// The places; clones share them. Only holders that have one take memory.
#[derive(Debug, Clone)]
pub(crate) struct Slots<K: Copy + Eq + Hash>(Arc<Inner<K>>);

#[derive(Debug)]
struct Inner<K> {
    capacity: Capacity,
    taken: Mutex<HashMap<K, usize>>,
}

impl<K: Copy + Eq + Hash> Slots<K> {
    pub(crate) fn new(capacity: Capacity) -> Self {
        Self(Arc::new(Inner { capacity, taken: Mutex::default() }))
    }

    pub(crate) fn capacity(&self) -> Capacity {
        self.0.capacity
    }

    /// Takes a place for a holder.
    ///
    /// # Errors
    /// What is taken, if that is all, or all that one holder may have.
    pub(crate) fn take(&self, holder: K) -> Result<Slot<K>, Taken> {
        let Capacity { all, each } = self.0.capacity;
        let mut counts = self.lock();
        let by_holder = counts.get(&holder).copied().unwrap_or(0);
        let taken = Taken { by_all: counts.values().sum(), by_holder };
        if taken.by_all >= all || taken.by_holder >= each {
            return Err(taken);
        }
        counts.insert(holder, by_holder + 1);
        Ok(Slot { slots: self.clone(), holder })
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<K, usize>> {
        self.0.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A place that is held until this is dropped.
#[derive(Debug)]
pub(crate) struct Slot<K: Copy + Eq + Hash> {
    slots: Slots<K>,
    holder: K,
}

impl<K: Copy + Eq + Hash> Drop for Slot<K> {
    fn drop(&mut self) {
        let mut counts = self.slots.lock();
        if let Some(count) = counts.get_mut(&self.holder) {
            *count -= 1;
            if *count == 0 {
                counts.remove(&self.holder);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_holder_cannot_take_the_places_of_all() {
        let slots = Slots::new(Capacity { all: 3, each: 2 });
        let (first, _second) = (slots.take('a').expect("a place"), slots.take('a').expect("a place"));
        assert_eq!(slots.take('a').expect_err("its share is used up"), Taken { by_all: 2, by_holder: 2 });
        let third = slots.take('b').expect("a place is left for others");
        assert_eq!(slots.take('b').expect_err("none is left"), Taken { by_all: 3, by_holder: 1 });
        drop(third);
        assert!(slots.take('a').is_err());
        drop(first);
        let _again = slots.take('a').expect("a place that was given back");
        let _other = slots.take('b').expect("a place");
        assert_eq!(slots.lock().len(), 2);
    }

    #[test]
    fn one_holder_leaves_a_place_wherever_there_are_two() {
        for (all, each) in [(0, 1), (1, 1), (2, 1), (3, 2), (4, 3), (8, 6)] {
            assert_eq!(Capacity::shared(all).each, each, "of {all}");
        }
    }

    #[test]
    fn holders_without_a_place_take_no_memory() {
        let slots = Slots::new(Capacity { all: usize::MAX, each: 1 });
        drop([slots.take('a').expect("a place"), slots.take('b').expect("a place")]);
        assert!(slots.lock().is_empty());
        let closed = Slots::new(Capacity { all: usize::MAX, each: 0 });
        assert!(closed.take('a').is_err() && closed.lock().is_empty());
    }
}
