//! A value that is searched for once, however many ask at a time, and kept for a while.

use std::{
    future::Future,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

use tokio::sync::watch::{self, error::RecvError};

/// The latest search, and what it found.
#[derive(Debug)]
pub(crate) struct Cached<T>(Mutex<Option<Search<T>>>);

/// What a search finds, and when; `None` while it is under way.
type Search<T> = watch::Receiver<Option<(Instant, T)>>;

impl<T> Default for Cached<T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<T: Clone + Send + Sync + 'static> Cached<T> {
    /// What was found less than `age` ago, or else what `find` finds. Concurrent callers wait for the same.
    ///
    /// # Errors
    /// If `find` panics.
    pub(crate) async fn get(
        &self,
        age: Duration,
        find: impl Future<Output = T> + Send + 'static,
    ) -> Result<T, RecvError> {
        let mut search = self.search(age, find);
        loop {
            if let Some((_, found)) = &*search.borrow_and_update() {
                return Ok(found.clone());
            }
            search.changed().await?;
        }
    }

    /// The latest search, or a new one if that ended longer ago than `age` or panicked.
    fn search(&self, age: Duration, find: impl Future<Output = T> + Send + 'static) -> Search<T> {
        let mut latest = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = latest.as_ref().filter(|search| match &*search.borrow() {
            Some((at, _)) => at.elapsed() < age,
            None => search.has_changed().is_ok(),
        });
        if let Some(search) = fresh {
            return search.clone();
        }
        let (sender, search) = watch::channel(None);
        // A task of its own, so that it ends and is cached also if the client that asked has gone.
        tokio::spawn(async move {
            let found = find.await;
            sender.send_replace(Some((Instant::now(), found)));
        });
        *latest = Some(search.clone());
        search
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    };

    use tokio::time::timeout;
    use tokio_util::sync::CancellationToken;

    use super::*;

    const LONG: Duration = Duration::from_secs(600);

    #[tokio::test]
    async fn what_a_client_that_has_gone_asked_for_is_found_once_and_cached() {
        let (cached, searches) = (Cached::default(), Arc::new(AtomicU32::new(0)));
        let released = CancellationToken::new();
        let find = || {
            let (searches, released) = (Arc::clone(&searches), released.clone());
            async move {
                let number = 1 + searches.fetch_add(1, Ordering::SeqCst);
                released.cancelled().await;
                number
            }
        };
        for _ in 0..10 {
            let cut_off = timeout(Duration::from_millis(5), cached.get(LONG, find())).await;
            assert!(cut_off.is_err(), "the search takes longer");
        }
        released.cancel();
        assert_eq!(cached.get(LONG, find()).await.ok(), Some(1), "all asked the same search");
        let again = cached.get(Duration::ZERO, find()).await.ok();
        assert_eq!(again, Some(2), "what is too old is searched for again");
        assert_eq!(searches.load(Ordering::SeqCst), 2);
    }

    #[tokio::test]
    async fn a_search_that_panicked_is_begun_again() {
        let cached = Cached::default();
        assert!(cached.get(LONG, async { panic!("as the test wants it") }).await.is_err());
        assert_eq!(cached.get(LONG, async { 1 }).await.ok(), Some(1));
    }
}
