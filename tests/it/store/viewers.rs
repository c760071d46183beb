//! The list of viewers, on a manual clock.

use std::sync::Arc;

use jiff::SignedDuration;
use tcgs::{
    domain::{ManualClock, ViewerToken},
    store::{QueuePolicy, Store, VIEWER_LIFE, ViewerRecord},
};

use crate::support::database::Database;

fn viewer(url: &str, token: &str) -> ViewerRecord {
    ViewerRecord {
        url: url.into(),
        version: "1.2.3".into(),
        identity: format!("adapter of {url}"),
        token: ViewerToken::stored(token.into()),
    }
}

async fn alive(store: &Store) -> Vec<(String, String, String)> {
    let found = store.live_viewers().await.expect("read");
    found.into_iter().map(|one| (one.url, one.identity, one.token.expose().to_owned())).collect()
}

fn row(url: &str, token: &str) -> (String, String, String) {
    (url.into(), format!("adapter of {url}"), token.into())
}

#[tokio::test]
async fn a_viewer_is_alive_while_it_is_announced_and_a_later_process_takes_its_address_over() {
    let Some(database) = super::database().await else { return };
    let database: Database = database;
    let clock = Arc::new(ManualClock::new("2026-11-24T12:00:00Z".parse().expect("an instant")));
    let store = database.open(clock.clone(), QueuePolicy::default()).await;
    assert_eq!(alive(&store).await, []);

    let (one, other) = (viewer("http://a:1", "first"), viewer("http://b:1", "second"));
    store.announce_viewer(&other).await.expect("announced");
    store.announce_viewer(&one).await.expect("announced");
    assert_eq!(alive(&store).await, [row("http://a:1", "first"), row("http://b:1", "second")]);

    clock.advance(VIEWER_LIFE.try_into().expect("in range"));
    store.announce_viewer(&one).await.expect("announced");
    clock.advance(SignedDuration::from_secs(1));
    assert_eq!(alive(&store).await, [row("http://a:1", "first")], "the other was not heard of");

    let restarted = viewer("http://a:1", "third");
    store.announce_viewer(&restarted).await.expect("announced");
    store.withdraw_viewer(&one).await.expect("withdrawn");
    assert_eq!(alive(&store).await, [row("http://a:1", "third")], "what has ended takes nothing with it");
    store.withdraw_viewer(&restarted).await.expect("withdrawn");
    assert_eq!(alive(&store).await, []);

    clock.advance(SignedDuration::from_hours(2));
    store.announce_viewer(&restarted).await.expect("announced");
    assert_eq!(database.number("SELECT COUNT(*) FROM viewers").await, 1, "old rows go");
}
