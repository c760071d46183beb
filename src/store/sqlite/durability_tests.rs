//! How the database is opened.

use std::sync::Arc;

use super::SqliteStore;
use crate::{domain::SystemClock, store::QueuePolicy};

/// As SQLite counts `synchronous`: 0 is OFF, 1 NORMAL, 2 FULL.
const FULL: i64 = 2;

#[tokio::test]
async fn every_connection_keeps_what_it_commits_through_a_power_cut() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("tcgs.db");
    let store =
        SqliteStore::open(&path, Arc::new(SystemClock), QueuePolicy::default()).await.expect("a database");
    let (synchronous,): (i64,) =
        sqlx::query_as("PRAGMA synchronous").fetch_one(&store.writer).await.expect("an answer");
    assert_eq!(synchronous, FULL);
    let (journal,): (String,) =
        sqlx::query_as("PRAGMA journal_mode").fetch_one(&store.writer).await.expect("an answer");
    assert_eq!(journal, "wal");
    store.close().await;
}
