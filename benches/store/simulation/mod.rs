//! The queue under a simulated clock: many jobs of several projects, taken by many workers, some of which die.
//!
//! The store is the real one; only time, durations and fates of workers are simulated. Every claim is compared with what the simulation
//! knows: no job has two workers, none runs after its end, and no project runs more jobs than it may. The benchmark runs it in full, and a
//! test in small.

mod load;
mod report;

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap},
    sync::Arc,
    time::{Duration, Instant},
};

use jiff::{SignedDuration, Timestamp};
use tcgs::{
    domain::{
        Digest, JobId, JobState, ManualClock, Problem, ProblemType, ProjectId, ProjectLimits, TrainOptions,
    },
    store::{BlobRef, Lease, NewJob, NewProject, Outcome, QueuePolicy, Store, StoreError},
};
use uuid::Uuid;

pub(crate) use load::Size;
use load::{Draws, Fate, PROJECTS, SimulatedJob};
pub(crate) use report::Report;

/// Longer than the service's, so that a simulated day does not consist of heartbeats.
const LEASE: Duration = Duration::from_secs(600);
/// Simulated time between two looks of idle workers.
const POLL: u64 = 10_000_000;
/// Simulated time until a worker that died is there again.
const RESTART: u64 = 60_000_000;
/// Simulated time after which a project that came later must have caught up with others.
const CATCH_UP: u64 = 3_600_000_000;

/// The policy of the simulated queue: no job may fail for good, however often its workers die.
pub(crate) fn policy() -> QueuePolicy {
    QueuePolicy { lease: LEASE, max_attempts: 1000, max_worker_crashes: 1000, ..QueuePolicy::default() }
}

/// When the simulated clock starts.
pub(crate) fn clock() -> Arc<ManualClock> {
    Arc::new(ManualClock::new(Timestamp::from_second(1_790_000_000).unwrap_or(Timestamp::UNIX_EPOCH)))
}

/// What happens next, in the order of time.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    /// A running attempt renews its lease.
    Heartbeat(usize),
    /// A running attempt comes to its end, or to that of its worker.
    End(usize),
    /// A worker that slept through its lease reports success.
    Wake(usize),
    /// A new worker takes the place of a dead one.
    Restart,
    /// The late project's jobs arrive.
    Arrive,
    /// Idle workers ask for jobs.
    Poll,
}

/// An attempt that a worker was granted.
struct Attempt {
    lease: Lease,
    job: usize,
    fate: Fate,
    ends_at: u64,
    is_alive: bool,
}

struct Simulation<'a> {
    store: &'a Store,
    clock: &'a ManualClock,
    success: &'a (dyn Fn() -> Outcome + Sync),
    jobs: Vec<SimulatedJob>,
    created_at: Vec<u64>,
    /// Successful ends of each job, of which there is to be one.
    ends: Vec<u32>,
    attempts: Vec<Attempt>,
    /// The attempts that run, by job, and how many they are by project.
    live: HashMap<usize, usize>,
    running: [usize; PROJECTS.len()],
    worked: [u64; PROJECTS.len()],
    idle: usize,
    worker: u64,
    now: u64,
    order: u64,
    events: BinaryHeap<Reverse<(u64, u64, Event)>>,
    draws: Draws,
    report: Report,
}

fn project(place: usize) -> ProjectId {
    ProjectId(Uuid::from_u128(place as u128 + 1))
}

fn id(job: usize) -> JobId {
    JobId(Uuid::from_u128(job as u128 + 1))
}

fn cap(place: usize, workers: usize) -> Option<usize> {
    PROJECTS[place].cap.map(|part| (workers / part).max(1))
}

/// Runs the simulation to its end; `success` is what a finished attempt reports.
///
/// # Panics
/// If the queue does anything that it must not.
pub(crate) async fn run(
    store: &Store,
    clock: &ManualClock,
    size: Size,
    success: &(dyn Fn() -> Outcome + Sync),
) -> Report {
    let start = Instant::now();
    let mut draws = Draws::new(size.seed);
    let jobs = draws.jobs(size);
    let count = jobs.len();
    let mut simulation = Simulation {
        store,
        clock,
        success,
        jobs,
        created_at: vec![0; count],
        ends: vec![0; count],
        attempts: Vec::new(),
        live: HashMap::new(),
        running: [0; PROJECTS.len()],
        worked: [0; PROJECTS.len()],
        idle: size.workers,
        worker: 0,
        now: 0,
        order: 0,
        events: BinaryHeap::new(),
        draws,
        report: Report {
            size: Size { jobs: count, ..size },
            claims: 0,
            lost: 0,
            failed: 0,
            creating: Duration::ZERO,
            claiming: Duration::ZERO,
            longest_claim: Duration::ZERO,
            total: Duration::ZERO,
            makespan_micros: 0,
            ideal_micros: 0,
            greatest_spread: 0,
            waits: PROJECTS.iter().map(|share| (share.name, Vec::new())).collect(),
        },
    };
    simulation.prepare().await;
    while let Some(Reverse((at, _, event))) = simulation.events.pop() {
        simulation.advance(at);
        simulation.handle(event).await;
    }
    simulation.finish(start).await
}

impl Simulation<'_> {
    fn workers(&self) -> usize {
        self.report.size.workers
    }

    fn advance(&mut self, to: u64) {
        self.clock.advance(SignedDuration::from_micros((to - self.now) as i64));
        self.now = to;
    }

    fn schedule(&mut self, at: u64, event: Event) {
        self.order += 1;
        self.events.push(Reverse((at, self.order, event)));
    }

    /// Adds projects, and every job that is there from the beginning.
    async fn prepare(&mut self) {
        for (place, share) in PROJECTS.iter().enumerate() {
            let max_running_jobs = cap(place, self.workers()).map(|cap| cap as u32);
            let limits =
                ProjectLimits { max_running_jobs, max_priority: Some(100), ..ProjectLimits::default() };
            let new = NewProject { id: project(place), name: share.name.into(), limits };
            self.store.create_project(new).await.expect("created");
        }
        self.create(false).await;
        let work: u64 = self.jobs.iter().map(|job| job.micros).sum();
        let halfway = self.now + work / self.workers() as u64 / 2;
        self.schedule(halfway, Event::Arrive);
        self.schedule(self.now, Event::Poll);
    }

    async fn create(&mut self, late: bool) {
        let start = Instant::now();
        for job in 0..self.jobs.len() {
            let place = self.jobs[job].project;
            let share = PROJECTS[place];
            if share.is_late != late {
                continue;
            }
            let dataset = BlobRef { digest: Digest::of(b"a dataset"), bytes: 9 };
            let new = NewJob::new(id(job), TrainOptions::default(), dataset);
            let new = NewJob { project: project(place), priority: share.priority, ..new };
            self.store.create_job(new).await.expect("created");
            self.created_at[job] = self.now;
            self.advance(self.now + 1);
        }
        self.report.creating += start.elapsed();
    }

    async fn handle(&mut self, event: Event) {
        match event {
            Event::Heartbeat(attempt) => self.heartbeat(attempt).await,
            Event::End(attempt) => self.end(attempt).await,
            Event::Wake(attempt) => {
                let lease = self.attempts[attempt].lease.clone();
                let late = self.store.finish(&lease, (self.success)()).await;
                assert!(
                    matches!(late, Err(StoreError::LeaseLost { .. })),
                    "a stale attempt ended its job: {late:?}"
                );
                self.work_on().await;
            }
            Event::Restart => self.work_on().await,
            Event::Arrive => {
                // Their creation takes no simulated time that others would notice.
                self.create(true).await;
                self.poll().await;
            }
            Event::Poll => {
                self.store.expire_leases().await.expect("observed");
                self.poll().await;
                if self.ends.contains(&0) {
                    self.schedule(self.now + POLL, Event::Poll);
                }
            }
        }
    }

    /// Idle workers claim until there is nothing for them.
    async fn poll(&mut self) {
        while self.idle > 0 && self.claim().await {
            self.idle -= 1;
        }
    }

    /// A worker that is free claims, or becomes idle.
    async fn work_on(&mut self) {
        if !self.claim().await {
            self.idle += 1;
        }
    }

    async fn claim(&mut self) -> bool {
        self.worker += 1;
        let start = Instant::now();
        let claim = self.store.claim(&format!("worker {}", self.worker)).await.expect("an answer");
        let Some(claim) = claim else { return false };
        self.report.claiming += start.elapsed();
        self.report.longest_claim = self.report.longest_claim.max(start.elapsed());
        self.report.claims += 1;

        let job = claim.lease.job.0.as_u128() as usize - 1;
        let place = self.jobs[job].project;
        assert_eq!(self.ends[job], 0, "a job that has ended was granted");
        let (fate, part) = self.draws.fate();
        let takes = (self.jobs[job].micros as f64 * part) as u64;
        let ends_at = self.now + takes;
        let attempt = self.attempts.len();
        assert!(self.live.insert(job, attempt).is_none(), "a job was granted to two workers");
        self.running[place] += 1;
        self.worked[place] += takes;
        let cap = cap(place, self.workers());
        assert!(cap.is_none_or(|cap| self.running[place] <= cap), "{} runs too many", PROJECTS[place].name);
        if claim.lease.attempt == 1 {
            let waits = self.report.waits.entry(PROJECTS[place].name).or_default();
            waits.push(self.now - self.created_at[job]);
        }
        self.attempts.push(Attempt { lease: claim.lease, job, fate, ends_at, is_alive: true });
        self.schedule(ends_at, Event::End(attempt));
        self.schedule_heartbeat(attempt);
        if self.report.claims.is_multiple_of((self.jobs.len() / 200).max(1)) {
            self.compare_projects().await;
        }
        true
    }

    fn schedule_heartbeat(&mut self, attempt: usize) {
        let at = self.now + LEASE.as_micros() as u64 / 3;
        if at < self.attempts[attempt].ends_at {
            self.schedule(at, Event::Heartbeat(attempt));
        }
    }

    async fn heartbeat(&mut self, attempt: usize) {
        if self.attempts[attempt].is_alive {
            self.store.heartbeat(&self.attempts[attempt].lease).await.expect("the lease is held");
            self.schedule_heartbeat(attempt);
        }
    }

    async fn end(&mut self, attempt: usize) {
        let Attempt { lease, job, fate, .. } = &self.attempts[attempt];
        let (lease, job, fate) = (lease.clone(), *job, *fate);
        self.attempts[attempt].is_alive = false;
        self.live.remove(&job).expect("it ran");
        self.running[self.jobs[job].project] -= 1;
        match fate {
            Fate::Succeeds => {
                self.store.finish(&lease, (self.success)()).await.expect("the attempt is current");
                self.ends[job] += 1;
                self.report.makespan_micros = self.now;
                self.work_on().await;
            }
            Fate::Fails => {
                self.report.failed += 1;
                let cause = Problem::new(ProblemType::DeviceLost, "the adapter went away");
                self.store.finish(&lease, Outcome::Retry(cause)).await.expect("the attempt is current");
                self.work_on().await;
            }
            Fate::Dies => {
                self.report.lost += 1;
                self.schedule(self.now + RESTART, Event::Restart);
            }
            Fate::Sleeps => {
                self.report.lost += 1;
                self.schedule(self.now + 2 * LEASE.as_micros() as u64, Event::Wake(attempt));
            }
        }
    }

    /// Holds what the store says of the projects to their caps, and those of equal rank with jobs waiting to each other.
    async fn compare_projects(&mut self) {
        let mut equals = Vec::new();
        for (place, share) in PROJECTS.iter().enumerate() {
            let usage =
                self.store.project_usage(Some(project(place)), None, 1).await.expect("read").remove(0);
            let of = |state| usage.jobs.iter().find(|(of, _)| *of == state).map_or(0, |(_, count)| *count);
            let (queued, running) = (of(JobState::Queued), of(JobState::Running));
            let cap = cap(place, self.workers());
            assert!(cap.is_none_or(|cap| running <= cap as u64), "{} runs {running} jobs", share.name);
            // Jobs that wait for their next attempt are queued and not due.
            let has_due = queued > self.workers() as u64 / 10 + 10;
            let is_settled = !share.is_late && self.now > CATCH_UP / 10;
            if share.priority == 0 && cap.is_none() && has_due && is_settled {
                equals.push(running);
            }
        }
        if let (Some(most), Some(fewest)) = (equals.iter().max(), equals.iter().min()) {
            self.report.greatest_spread = self.report.greatest_spread.max(most - fewest);
        }
    }

    /// Holds the end to what there was at the beginning.
    async fn finish(mut self, start: Instant) -> Report {
        assert!(self.ends.iter().all(|ends| *ends == 1), "every job ends once");
        assert!(self.live.is_empty() && self.idle == self.workers(), "every worker is idle");
        let ideal =
            |place: usize| self.worked[place] / cap(place, self.workers()).unwrap_or(usize::MAX) as u64;
        let whole = self.worked.iter().sum::<u64>() / self.workers() as u64;
        self.report.ideal_micros = (0..PROJECTS.len()).map(ideal).max().unwrap_or(0).max(whole);
        self.report.waits.values_mut().for_each(|waits| waits.sort_unstable());
        self.report.total = start.elapsed();
        self.report
    }
}
