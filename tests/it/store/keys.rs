//! Keys and their changes, on a manual clock.

use std::{num::NonZeroU32, sync::Arc};

use jiff::SignedDuration;
use tcgs::{
    domain::{Clock as _, ManualClock, ProjectId, Scope, SystemRandom},
    store::{KeyChange, KeyProject, KeyRecord, KeyRequest, NewKey, QueuePolicy, Store},
};

use crate::support::database::Database;

fn clock() -> Arc<ManualClock> {
    Arc::new(ManualClock::new("2026-11-24T12:00:00Z".parse().expect("an instant")))
}

fn drawn(clock: &ManualClock) -> NewKey {
    let project = KeyProject::Existing(ProjectId::DEFAULT);
    let request = KeyRequest { name: "a key", scopes: &[Scope::Admin], project, ..KeyRequest::default() };
    NewKey::generate(&SystemRandom, clock.now(), request).expect("a key").0
}

#[tokio::test]
async fn changes_that_were_made_of_the_same_record_keep_each_others_fields() {
    let Some(database) = super::database().await else { return };
    let database: Database = database;
    let clock = clock();
    let store: Store = database.open(clock.clone(), QueuePolicy::default()).await;
    let record = store.create_key(drawn(&clock)).await.expect("created");
    let (rate, expires_at) = (NonZeroU32::new(5), Some(clock.now() + SignedDuration::from_hours(1)));
    let name = KeyChange { name: Some(" renamed ".into()), ..KeyChange::default() };
    let rated = KeyChange { requests_per_minute: Some(rate), ..KeyChange::default() };
    let expiring = KeyChange { expires_at: Some(expires_at), ..KeyChange::default() };
    for change in [name, rated, expiring, KeyChange::default()] {
        let change = change.checked(&record, clock.now()).expect("a valid change");
        store.update_key(record.id, change).await.expect("changed").expect("a key");
    }
    let name = "renamed".to_owned();
    let changed = KeyRecord { name, requests_per_minute: rate, expires_at, ..record.clone() };
    assert_eq!(store.key(record.id).await.expect("read"), Some(changed.clone()));

    let cleared =
        KeyChange { requests_per_minute: Some(None), expires_at: Some(None), ..KeyChange::default() };
    let changed = KeyRecord { requests_per_minute: None, expires_at: None, ..changed };
    assert_eq!(store.update_key(record.id, cleared.clone()).await.expect("changed"), Some(changed));
    store.revoke_key(record.id).await.expect("revoked");
    assert_eq!(store.update_key(record.id, cleared).await.expect("read"), None);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_processes_that_make_the_first_key_together_one_does() {
    let Some(database) = super::database().await else { return };
    let database: Database = database;
    let clock = clock();
    let mut stores = Vec::new();
    for _ in 0..4 {
        stores.push(database.open(clock.clone(), QueuePolicy::default()).await);
    }
    let making: Vec<_> = stores
        .iter()
        .map(|store| {
            let (store, new) = (store.clone(), drawn(&clock));
            tokio::spawn(async move { store.create_first_key(new).await.expect("an answer") })
        })
        .collect();
    let mut made = Vec::new();
    for task in making {
        made.extend(task.await.expect("no panic"));
    }
    assert_eq!(stores[0].keys(None, true, None, 10).await.expect("read"), made);
    assert_eq!(made.len(), 1);
    stores[1].revoke_key(made[0].id).await.expect("revoked");
    assert_eq!(stores[2].create_first_key(drawn(&clock)).await.expect("read"), None, "it was the first");
}
