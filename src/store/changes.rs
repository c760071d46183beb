//! Tells waiting tasks that something has changed, where the database can tell.

use tokio::sync::watch;

/// What a task waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChangeKind {
    /// A job may have become claimable.
    Queue,
    /// A job has a new event.
    Events,
}

/// Changes of one kind. What happens between two waits ends the second at once.
///
/// Notifications can be lost, so whoever waits also asks at intervals ([`Changes::is_live`]).
#[derive(Debug, Clone)]
pub struct Changes(Option<watch::Receiver<ListenerState>>);

/// What a listener knows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct ListenerState {
    /// Whether it is connected.
    pub(super) is_live: bool,
    /// How many changes it was told of.
    pub(super) count: u64,
}

impl Changes {
    /// Of a database that cannot tell.
    #[must_use]
    pub fn never() -> Self {
        Self(None)
    }

    pub(super) fn of(receiver: watch::Receiver<ListenerState>) -> Self {
        Self(Some(receiver))
    }

    /// Whether the database tells of changes at present. If not, they are found only by asking.
    #[must_use]
    pub fn is_live(&self) -> bool {
        self.0.as_ref().is_some_and(|told| told.borrow().is_live)
    }

    /// Waits for a change since the last wait, for ever if the database cannot tell.
    pub async fn wait(&mut self) {
        let ended = match &mut self.0 {
            Some(told) => told.changed().await.is_err(),
            None => true,
        };
        if ended {
            std::future::pending().await
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn a_change_ends_a_wait_and_where_nothing_tells_of_changes_no_wait_ends() {
        let told = watch::Sender::new(ListenerState::default());
        let mut changes = Changes::of(told.subscribe());
        assert!(!changes.is_live() && changes.wait().now_or_never().is_none(), "it is not connected yet");
        told.send_modify(|told| told.is_live = true);
        changes.wait().now_or_never().expect("told of a change");
        assert!(changes.is_live() && changes.wait().now_or_never().is_none(), "told once");
        drop(told);
        assert!(!Changes::never().is_live());
        for mut silent in [changes, Changes::never()] {
            assert!(silent.wait().now_or_never().is_none());
        }
    }
}
