//! What the simulated projects ask for, and what happens to workers; all of it follows from a seed.

use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;

/// How large a simulation is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Size {
    /// Jobs of all projects.
    pub(crate) jobs: usize,
    /// Workers that run one job at a time.
    pub(crate) workers: usize,
    /// Of everything random.
    pub(crate) seed: u64,
}

/// A project of the simulation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Share {
    pub(crate) name: &'static str,
    /// Its part of all jobs, in thousandths.
    pub(crate) permille: usize,
    pub(crate) priority: i32,
    /// It may run this part of the workers at once.
    pub(crate) cap: Option<usize>,
    /// Whether its jobs come only in the middle of the run.
    pub(crate) is_late: bool,
}

const PLAIN: Share = Share { name: "", permille: 120, priority: 0, cap: None, is_late: false };

/// One project has half of the jobs; three have as many as each other; the others test caps, priorities and arrivals.
pub(crate) const PROJECTS: [Share; 8] = [
    Share { name: "bulk", permille: 500, ..PLAIN },
    Share { name: "first", ..PLAIN },
    Share { name: "second", ..PLAIN },
    Share { name: "third", ..PLAIN },
    Share { name: "capped", permille: 40, cap: Some(20), ..PLAIN },
    Share { name: "urgent", permille: 30, priority: 10, cap: Some(10), ..PLAIN },
    Share { name: "late", permille: 20, is_late: true, ..PLAIN },
    Share { name: "background", permille: 50, priority: -10, ..PLAIN },
];

/// Mean of the jobs' durations, which are distributed exponentially between a fifteenth and six times that.
const MEAN_SECONDS: f64 = 300.0;

/// A job of the simulation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SimulatedJob {
    /// Its project's place in [`PROJECTS`].
    pub(crate) project: usize,
    /// How long it takes a worker from its beginning to its end.
    pub(crate) micros: u64,
}

/// How an attempt goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fate {
    /// To its end.
    Succeeds,
    /// It reports an error of the machine.
    Fails,
    /// Its worker dies.
    Dies,
    /// Its worker stops for twice the lease, and then goes on as if it still had the job.
    Sleeps,
}

/// Draws jobs and fates.
pub(crate) struct Draws(Pcg64);

impl Draws {
    pub(crate) fn new(seed: u64) -> Self {
        Self(Pcg64::seed_from_u64(seed))
    }

    /// The jobs in the order in which they are queued, with those of all projects mixed.
    pub(crate) fn jobs(&mut self, size: Size) -> Vec<SimulatedJob> {
        let mut jobs = Vec::with_capacity(size.jobs);
        for (project, share) in PROJECTS.iter().enumerate() {
            for _ in 0..(size.jobs * share.permille).div_ceil(1000) {
                let part: f64 = self.0.random_range(1e-9..1.0);
                let seconds = (-part.ln()).clamp(1.0 / 15.0, 6.0) * MEAN_SECONDS;
                jobs.push(SimulatedJob { project, micros: (seconds * 1e6) as u64 });
            }
        }
        for place in (1..jobs.len()).rev() {
            jobs.swap(place, self.0.random_range(0..=place));
        }
        jobs
    }

    /// How an attempt goes, and the part of its duration after which that happens.
    pub(crate) fn fate(&mut self) -> (Fate, f64) {
        let (draw, part): (f64, f64) = (self.0.random_range(0.0..1.0), self.0.random_range(0.0..1.0));
        match draw {
            0.0..0.005 => (Fate::Dies, part),
            0.005..0.01 => (Fate::Sleeps, part),
            0.01..0.015 => (Fate::Fails, part),
            _ => (Fate::Succeeds, 1.0),
        }
    }
}
