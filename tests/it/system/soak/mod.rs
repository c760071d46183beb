//! Services and workers are killed at random moments while clients send jobs and follow them. Every job succeeds once, with the files of a
//! run that nobody disturbs, and nothing is lost or left over.
//!
//! `TCGS_SOAK_KILLS` kills on each kind of storage (`make soak` asks for many), at moments that `TCGS_SOAK_SEED` decides.

mod client;
mod killer;

use std::{
    collections::{BTreeMap, BTreeSet},
    env,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    time::Instant,
};

use serde_json::Value;
use tokio::sync::OnceCell;

use self::{
    client::{Client, Followed},
    killer::Killer,
};
use crate::support::{bucket::SECRET, dataset, deployment::Deployment, postgres::PASSWORD};

/// Kills in a run of all tests.
const A_HANDFUL: u32 = 4;
/// Clients, each with one job at a time.
const CLIENTS: u32 = 3;
/// Worker processes.
const WORKERS: usize = 2;

/// Options of jobs, so different that no file could be taken for another's.
const RECIPES: [&str; 4] = [
    "preset=preview&iterations=30&seed=1",
    "preset=preview&iterations=40&seed=2",
    "model=3dgs&iterations=60&seed=3",
    "preset=preview&iterations=40&seed=4&rd_curve=0.002,0.02",
];

/// The artifacts of a job, by kind and place.
type Artifacts = BTreeMap<String, String>;

fn number(variable: &str) -> Option<u64> {
    Some(env::var(variable).ok()?.parse().unwrap_or_else(|_| panic!("{variable} is no number")))
}

/// What jobs of each recipe leave if nobody disturbs them.
async fn undisturbed() -> &'static [Artifacts] {
    static ONCE: OnceCell<Vec<Artifacts>> = OnceCell::const_new();
    let run = async || {
        let deployment = Deployment::local();
        let service = deployment.start(1).await;
        let mut jobs = Vec::new();
        for recipe in RECIPES {
            let created = service.upload(&format!("?{recipe}"), dataset::zip()).await.expect(201);
            jobs.push(created.header("location").to_owned());
        }
        for job in &jobs {
            service.succeeded(job).await;
        }
        assert!(service.stop().await.success());
        let mut artifacts = deployment.artifacts().await;
        let of = |job: &String| artifacts.remove(job.trim_start_matches("/v1/jobs/")).expect("some");
        jobs.iter().map(of).collect()
    };
    ONCE.get_or_init(run).await
}

/// What came of a soak.
struct Soak {
    deployment: Deployment,
    followed: Vec<Followed>,
    after: String,
}

impl Soak {
    async fn run(deployment: Deployment, kind: &str) -> Self {
        let seed = number("TCGS_SOAK_SEED").unwrap_or(20);
        let kills = number("TCGS_SOAK_KILLS").map_or(A_HANDFUL, |kills| kills.try_into().expect("few"));
        let after = format!("{kills} kills with TCGS_SOAK_SEED={seed} on {kind}");
        println!("soak: {after}");
        let deployment = deployment.with("TCGS_CHECKPOINT_EVERY", "500ms");
        let began = Instant::now();
        let mut killer = Killer::start(&deployment, WORKERS, seed).await;
        let (next, over) = (Arc::new(AtomicU32::new(0)), Arc::new(AtomicBool::new(false)));
        let clients: Vec<_> = (0..CLIENTS)
            .map(|client| {
                let client =
                    Client::new(killer.address(), seed, client, Arc::clone(&next), Arc::clone(&over));
                tokio::spawn(client.send_jobs())
            })
            .collect();
        killer.kill(kills).await;
        over.store(true, Ordering::Relaxed);
        let mut followed = Vec::new();
        for client in clients {
            // A client's own fault names itself; the service's log says why.
            followed
                .extend(client.await.unwrap_or_else(|error| panic!("{after}: {error}\n{}", killer.log())));
        }
        deployment.checkpoints_are_gone().await;
        let log = killer.stop().await;
        for unwanted in ["panicked", PASSWORD, SECRET] {
            assert!(!log.contains(unwanted), "{after}: the log shows '{unwanted}':\n{log}");
        }
        println!("soak: {} s of kills and jobs\n{}", began.elapsed().as_secs(), killer.table());
        Self { deployment, followed, after }
    }

    /// Each job exists once and succeeded once, with the files of an undisturbed run.
    async fn check_jobs(&self) {
        let (database, after) = (&self.deployment.database, &self.after);
        let jobs: BTreeSet<&str> = self.followed.iter().map(|followed| &*followed.job).collect();
        assert_eq!(jobs.len(), self.followed.len(), "{after}: two keys have one job");
        let known = database.rows("SELECT id, state FROM jobs ORDER BY id", 2).await;
        let expected: Vec<Vec<String>> =
            jobs.iter().map(|job| vec![(*job).to_owned(), "succeeded".to_owned()]).collect();
        assert_eq!(known, expected, "{after}");
        let artifacts = self.deployment.artifacts().await;
        for followed in &self.followed {
            let expected = &undisturbed().await[followed.recipe];
            assert_eq!(&artifacts[&followed.job], expected, "{after}: job {}", followed.job);
        }
        // Attempts are numbered without gaps, all have ended, and the last alone has succeeded.
        let attempts = "SELECT job_id, count(*) || ' ' || max(number) || ' ' || count(ended_at) || ' ' ||
            count(*) FILTER (WHERE outcome = 'succeeded') || ' ' || max(CASE WHEN outcome = 'succeeded' THEN number END)
            FROM attempts GROUP BY job_id";
        for row in database.rows(attempts, 2).await {
            let numbers: Vec<u64> =
                row[1].split(' ').map(|number| number.parse().expect("a number")).collect();
            let [count, last, ended, succeeded, which] = numbers[..] else { panic!("{row:?}") };
            assert_eq!((count, ended, succeeded, which), (last, last, 1, last), "{after}: {row:?}");
        }
        let outcomes = "SELECT outcome, count(*) FROM attempts GROUP BY outcome ORDER BY outcome";
        let outcomes = database.rows(outcomes, 2).await;
        let usual = ["lost", "released", "succeeded"];
        assert!(outcomes.iter().all(|row| usual.contains(&&*row[0])), "{after}: {outcomes:?}");
        println!("soak: {} jobs, attempts by outcome {outcomes:?}", self.followed.len());
    }

    /// Events of each job are numbered without gaps, one of them ends the job, and its client has seen each once.
    async fn check_events(&self) {
        let (database, after) = (&self.deployment.database, &self.after);
        let mut connections = 0;
        let mut total = 0;
        for followed in &self.followed {
            let events =
                format!("SELECT seq, kind, data FROM events WHERE job_id = '{}' ORDER BY seq", followed.job);
            let kept = database.rows(&events, 3).await;
            let numbers: Vec<u64> = kept.iter().map(|row| row[0].parse().expect("a number")).collect();
            let count = kept.len() as u64;
            assert_eq!(numbers, (1..=count).collect::<Vec<_>>(), "{after}: job {}", followed.job);
            let seen: Vec<u64> = followed.events.iter().map(|event| event.number()).collect();
            assert_eq!(seen, numbers, "{after}: what the client of job {} has seen", followed.job);
            for (row, event) in kept.iter().zip(&followed.events) {
                let data: Value = serde_json::from_str(&row[2]).expect("JSON");
                assert_eq!((&row[1], &data), (&event.event, &event.json()["data"]), "{after}");
            }
            let ends = |row: &&Vec<String>| row[1] == "state" && row[2].contains("\"succeeded\"");
            assert_eq!(kept.iter().filter(ends).count(), 1, "{after}: {kept:?}");
            assert!(kept.last().as_ref().is_some_and(ends), "{after}: {kept:?}");
            connections += followed.connections;
            total += count;
        }
        println!("soak: {total} events, each seen once by a client that connected {connections} times");
    }
}

async fn soak(deployment: Deployment, kind: &str) {
    undisturbed().await;
    let soak = Soak::run(deployment, kind).await;
    soak.check_jobs().await;
    soak.check_events().await;
    let collected = soak.deployment.assert_tidy(&soak.after).await;
    println!("soak: {} unreferenced blobs collected, none is left; nothing is lost", collected.blobs);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_lost_on_sqlite_and_a_folder_however_often_processes_are_killed() {
    soak(Deployment::local(), "SQLite and a folder").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_lost_on_postgres_and_a_bucket_however_often_processes_are_killed() {
    let Some(deployment) = Deployment::shared().await else { return };
    soak(deployment, "PostgreSQL and S3").await;
}
