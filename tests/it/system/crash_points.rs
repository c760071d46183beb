//! A process dies at each named point in turn ([`FailurePoint`]). The next one goes on, and the job has the files of an undisturbed run.

use std::{collections::BTreeMap, env, fs, path::Path, time::Duration};

use tcgs::domain::FailurePoint;
use tokio::time::sleep;

use crate::support::{
    dataset, deployment::Deployment, eventually::eventually, service::Service, skip::skip_in_ci_too,
};

/// Options of the jobs.
const RECIPE: &str = "model=3dgs&iterations=12&seed=5";
/// Pause before a request is repeated.
const PAUSE: Duration = Duration::from_millis(20);

/// Who dies at a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Victim {
    Service,
    Worker,
}

/// The points at which a process dies on PostgreSQL and a bucket in a run of all tests: those at which the storage matters.
const OF_STORAGE: [FailurePoint; 8] = [
    FailurePoint::BlobAnnounced,
    FailurePoint::BlobStored,
    FailurePoint::BeforeCreate,
    FailurePoint::BeforeClaim,
    FailurePoint::AfterCheckpoint,
    FailurePoint::AfterPublish,
    FailurePoint::BeforeCommit,
    FailurePoint::AfterCommit,
];

/// Deaths of workers after which the service is started again: a supervisor waits longer after each.
const DEATHS: u32 = 3;

/// Each point with the visits of it at which a process dies, one job for each, and who dies.
fn plan(has_bucket: bool) -> Vec<(FailurePoint, u32, Victim)> {
    let all = FailurePoint::ALL.iter().flat_map(|point| {
        let (visits, victim): (&[u32], _) = match point {
            // The dataset's, which the service publishes; results have other points.
            FailurePoint::BlobAnnounced | FailurePoint::BlobStored if !has_bucket => (&[], Victim::Service),
            FailurePoint::BlobAnnounced | FailurePoint::BlobStored => (&[1], Victim::Service),
            FailurePoint::BeforeCreate | FailurePoint::AfterCreate => (&[1], Victim::Service),
            FailurePoint::Step => (&[1, 7], Victim::Worker),
            FailurePoint::BeforeCheckpoint | FailurePoint::AfterCheckpoint => (&[2], Victim::Worker),
            // A scene, its cameras and the pictures of held-out views.
            FailurePoint::BeforePublish | FailurePoint::AfterPublish => (&[1, 3], Victim::Worker),
            FailurePoint::BeforeClaim
            | FailurePoint::AfterClaim
            | FailurePoint::Ingest
            | FailurePoint::BeforeEncode
            | FailurePoint::AfterEncode
            | FailurePoint::BeforeCommit
            | FailurePoint::AfterCommit => (&[1], Victim::Worker),
        };
        visits.iter().map(move |visit| (*point, *visit, victim))
    });
    all.collect()
}

/// What a job leaves: its state, how many of its events end it, and its files.
#[derive(Debug, PartialEq, Eq)]
struct Left {
    state: String,
    ends: i64,
    artifacts: BTreeMap<String, String>,
}

async fn left(deployment: &Deployment, job: &str) -> Left {
    let database = &deployment.database;
    let state = database.rows(&format!("SELECT state FROM jobs WHERE id = '{job}'"), 1).await;
    let ends =
        "SELECT count(*) FROM events WHERE kind = 'state' AND data LIKE '%\"succeeded\"%' AND job_id = ";
    Left {
        state: state[0][0].clone(),
        ends: database.number(&format!("{ends}'{job}'")).await,
        artifacts: deployment.artifacts().await.remove(job).unwrap_or_default(),
    }
}

/// Creates a job at a service that may die meanwhile; then starts another one and repeats the request.
async fn create(deployment: &Deployment, service: &mut Service, key: &str) -> String {
    let http = tcgs::https::client_builder().expect("TLS").build().expect("a client");
    loop {
        let request = http
            .post(format!("http://{}/v1/jobs?{RECIPE}", service.address()))
            .header("content-type", "application/zip")
            .header("idempotency-key", key)
            .body(dataset::zip());
        match request.send().await {
            Ok(answer) if answer.status() == 201 => {
                let location = answer.headers()["location"].to_str().expect("ASCII");
                return location.trim_start_matches("/v1/jobs/").to_owned();
            }
            Ok(answer) => panic!("{}: {}", answer.status(), answer.text().await.unwrap_or_default()),
            Err(_) => {
                eventually("the service has died", async || service.ended().is_some()).await;
                *service = deployment.start(1).await;
            }
        }
        sleep(PAUSE).await;
    }
}

async fn a_process_dies_at_every_point(deployment: Deployment) {
    if !cfg!(debug_assertions) {
        return skip_in_ci_too("failures are planned in builds with debug assertions alone");
    }
    let plan_file = deployment.data().join("failure-plan");
    let deployment = deployment.with("TCGS_CHECKPOINT_EVERY", "0s");
    let deployment = deployment.with("TCGS_FAIL_AT", plan_file.to_str().expect("UTF-8"));
    let mut service = deployment.start(1).await;
    let job = create(&deployment, &mut service, "undisturbed").await;
    service.succeeded(&format!("/v1/jobs/{job}")).await;
    let undisturbed = left(&deployment, &job).await;
    assert_eq!((undisturbed.artifacts.len(), undisturbed.ends), (4, 1), "{undisturbed:?}");
    let (mut jobs, mut deaths) = (1, 0);
    let all = env::var_os("TCGS_SOAK_KILLS").is_some() || !deployment.has_bucket();
    let plan = plan(deployment.has_bucket());
    for (point, visit, victim) in plan.into_iter().filter(|(point, ..)| all || OF_STORAGE.contains(point)) {
        let what = format!("a {victim:?} that dies at {point}:{visit}");
        write_plan(&plan_file, &format!("{point}:{visit}"));
        let before = service.address().to_owned();
        let job = create(&deployment, &mut service, &what).await;
        jobs += 1;
        assert_eq!(service.address() != before, victim == Victim::Service, "{what}");
        service.succeeded(&format!("/v1/jobs/{job}")).await;
        eventually(&what, async || !plan_file.exists()).await;
        assert_eq!(left(&deployment, &job).await, undisturbed, "{what}");
        let lost = format!("SELECT count(*) FROM attempts WHERE outcome = 'lost' AND job_id = '{job}'");
        let costs_an_attempt = victim == Victim::Worker
            && !matches!(point, FailurePoint::BeforeClaim | FailurePoint::AfterCommit);
        assert_eq!(deployment.database.number(&lost).await, i64::from(costs_an_attempt), "{what}");
        println!("planned failure: {what}, and the job has succeeded");
        deaths = if victim == Victim::Worker { deaths + 1 } else { 0 };
        if deaths == DEATHS {
            assert!(service.stop().await.success());
            (service, deaths) = (deployment.start(1).await, 0);
        }
    }
    assert_eq!(deployment.database.number("SELECT count(*) FROM jobs").await, jobs);
    deployment.checkpoints_are_gone().await;
    assert!(service.stop().await.success());
    fs::remove_file(&plan_file).expect_err("every plan was carried out");
    deployment.assert_tidy("planned failures").await;
}

/// Writes the whole plan at once.
fn write_plan(file: &Path, plan: &str) {
    let draft = file.with_extension("draft");
    fs::write(&draft, plan).expect("written");
    fs::rename(&draft, file).expect("renamed");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_process_that_dies_at_a_named_point_costs_nothing_on_sqlite_and_a_folder() {
    a_process_dies_at_every_point(Deployment::local()).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_process_that_dies_at_a_named_point_costs_nothing_on_postgres_and_a_bucket() {
    let Some(deployment) = Deployment::shared().await else { return };
    a_process_dies_at_every_point(deployment).await;
}
