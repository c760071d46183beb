//! The outbox of webhooks: whose message is next.

use std::time::Duration;

use jiff::SignedDuration;

use super::totals::Fixture;

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
