//! The outbox of webhooks: whose message is next, and what endpoints get that are disabled meanwhile.

use std::time::Duration;

use jiff::SignedDuration;
use sqlx::{Connection as _, PgConnection};
use tcgs::{
    domain::ProjectId,
    store::{AfterAttempt, DeliveryResult},
};

use super::totals::Fixture;
use crate::support::{database::Database, eventually::eventually};

const LEASE: Duration = Duration::from_secs(60);

impl Fixture {
    /// Takes a message that is due, and returns the number of its project.
    async fn take_of_project(&self) -> Option<u128> {
        let due = self.store.take_delivery(LEASE).await.expect("read")?;
        let of = "SELECT e.project FROM webhook_deliveries d JOIN webhook_endpoints e ON e.id = d.endpoint";
        let rows = self.database.rows(&format!("{of} WHERE d.id = '{}'", due.id), 1).await;
        Some(rows[0][0].parse::<uuid::Uuid>().expect("an id").as_u128())
    }
}

#[tokio::test]
async fn projects_take_turns_however_long_the_messages_of_one_have_been_due() {
    let Some(mut fixture) = Fixture::new().await else { return };
    for number in 1..=3 {
        let project = fixture.project(number).await;
        for _ in 0..3 {
            fixture.endpoint(project).await;
        }
        fixture.job(number, project, None, "a dataset").await;
        fixture.clock.advance(SignedDuration::from_secs(1));
    }
    let mut turns = Vec::new();
    while let Some(project) = fixture.take_of_project().await {
        turns.push(project);
    }
    assert_eq!(turns, [1, 2, 3, 1, 2, 3, 1, 2, 3]);
}

#[tokio::test]
async fn a_clock_that_is_set_back_delays_no_message() {
    let Some(fixture) = Fixture::new().await else { return };
    fixture.endpoint(ProjectId::DEFAULT).await;
    fixture.clock.set_by(SignedDuration::from_hours(48));
    fixture.job(1, ProjectId::DEFAULT, None, "a dataset").await;
    fixture.clock.set_by(SignedDuration::from_hours(-48));
    // One that is due in the future, and one whose sender died then.
    for attempt in 1..=2 {
        let due = fixture.store.take_delivery(LEASE).await.expect("read").expect("a message");
        assert_eq!(due.attempt, attempt);
        assert!(fixture.store.take_delivery(LEASE).await.expect("read").is_none(), "it is under way");
        fixture.clock.set_by(SignedDuration::from_hours(-1));
    }
    let due = fixture.store.take_delivery(LEASE).await.expect("read").expect("a message");
    let next = AfterAttempt::RetryAfter(Duration::from_secs(26 * 3600));
    let failed = DeliveryResult { response_status: Some(500), error: None, next };
    fixture.store.finish_delivery(due.id, due.attempt, failed).await.expect("written");
    assert!(fixture.store.take_delivery(LEASE).await.expect("read").is_none(), "a pause is waited out");
}

#[tokio::test]
async fn an_endpoint_that_is_being_disabled_gets_no_message() {
    let Some(fixture) = Fixture::new().await else { return };
    // SQLite writes one thing at a time.
    let Database::Postgres(postgres) = &fixture.database else { return };
    fixture.endpoint(ProjectId::DEFAULT).await;
    let mut connection = PgConnection::connect(postgres.url().expose()).await.expect("a connection");
    let mut disabling = connection.begin().await.expect("a transaction");
    let disabled = sqlx::query("UPDATE webhook_endpoints SET disabled_at = 1").execute(&mut *disabling).await;
    assert_eq!(disabled.expect("written").rows_affected(), 1);
    let (store, new) = (fixture.store.clone(), fixture.new_job(1, ProjectId::DEFAULT, "a dataset"));
    let creating = tokio::spawn(async move { store.create_job(new).await.expect("created") });
    let waiting = "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'";
    eventually("the job waits for the endpoint, or is there", async || {
        creating.is_finished() || fixture.database.number(waiting).await > 0
    })
    .await;
    disabling.commit().await.expect("committed");
    creating.await.expect("no panic");
    assert!(fixture.store.take_delivery(LEASE).await.expect("read").is_none());
}
