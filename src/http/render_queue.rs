//! Runs blocking renders a few at a time, with a bounded line before them.

use std::sync::Arc;

use tokio::{
    sync::Semaphore,
    task::{JoinError, spawn_blocking},
};

/// The line is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct QueueFull;

/// A bounded line of blocking work.
#[derive(Debug)]
pub(super) struct RenderQueue {
    places: Arc<Semaphore>,
    turns: Arc<Semaphore>,
}

impl RenderQueue {
    /// A line in which `at_once` work and `waiting` more wait.
    pub(super) fn new(at_once: usize, waiting: usize) -> Self {
        let at_once = at_once.max(1);
        let (places, turns) = (Semaphore::new(at_once + waiting), Semaphore::new(at_once));
        Self { places: Arc::new(places), turns: Arc::new(turns) }
    }

    /// Runs `work` on a blocking thread when its turn has come. Work whose caller goes away before that never runs.
    pub(super) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<Result<T, JoinError>, QueueFull> {
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| QueueFull)?;
        let turn = Arc::clone(&self.turns).acquire_owned().await.map_err(|_| QueueFull)?;
        Ok(spawn_blocking(move || {
            let result = work();
            drop((turn, place));
            result
        })
        .await)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[tokio::test]
    async fn the_line_is_bounded_and_moves_on() {
        let queue = Arc::new(RenderQueue::new(1, 1));
        let (release, gate) = mpsc::channel::<()>();
        let started = Arc::new(tokio::sync::Notify::new());
        let first = tokio::spawn({
            let (queue, started) = (Arc::clone(&queue), Arc::clone(&started));
            async move {
                queue
                    .run(move || {
                        started.notify_one();
                        gate.recv().is_ok()
                    })
                    .await
            }
        });
        started.notified().await;
        let second = tokio::spawn({
            let queue = Arc::clone(&queue);
            async move { queue.run(|| 2).await }
        });
        while queue.places.available_permits() > 0 {
            tokio::task::yield_now().await;
        }
        assert_eq!(queue.run(|| 3).await.map(Result::ok), Err(QueueFull));
        release.send(()).expect("the first still waits");
        assert!(first.await.expect("joined").expect("had a place").expect("ran"));
        assert_eq!(second.await.expect("joined").expect("had a place").ok(), Some(2));
        assert_eq!(queue.run(|| 4).await.map(Result::ok), Ok(Some(4)));
    }
}
