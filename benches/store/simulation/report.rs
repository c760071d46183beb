//! Figures of a simulation.

use std::{collections::BTreeMap, fmt, time::Duration};

use super::load::{PROJECTS, Size};

/// What a simulation found.
#[derive(Debug)]
pub(crate) struct Report {
    pub(crate) size: Size,
    /// Attempts that were granted.
    pub(crate) claims: usize,
    /// Attempts whose workers died or slept.
    pub(crate) lost: usize,
    /// Attempts that reported an error.
    pub(crate) failed: usize,
    /// Real time of creating jobs, of claims that granted one, and of the whole.
    pub(crate) creating: Duration,
    pub(crate) claiming: Duration,
    pub(crate) longest_claim: Duration,
    pub(crate) total: Duration,
    /// Simulated time from the first claim to the last end.
    pub(crate) makespan_micros: u64,
    /// The least that any scheduler needs: all the work spread over all workers, or that of a project over the workers that it may have.
    pub(crate) ideal_micros: u64,
    /// Greatest difference between the running jobs of two projects of the same rank that both had jobs waiting.
    pub(crate) greatest_spread: u64,
    /// Simulated time that each job waited for its first attempt, by project, sorted.
    pub(crate) waits: BTreeMap<&'static str, Vec<u64>>,
}

fn seconds(micros: u64) -> f64 {
    micros as f64 / 1e6
}

impl Report {
    /// Claims a second of real time.
    pub(crate) fn claims_per_second(&self) -> f64 {
        self.claims as f64 / self.claiming.as_secs_f64()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Size { jobs, workers, seed } = self.size;
        writeln!(
            f,
            "{jobs} jobs, {workers} workers, seed {seed}: {} claims, {} lost, {} failed",
            self.claims, self.lost, self.failed
        )?;
        writeln!(
            f,
            "{:.0} jobs created a second, {:.0} claims a second, the longest {:.1} ms, {:.0} s in all",
            jobs as f64 / self.creating.as_secs_f64(),
            self.claims_per_second(),
            self.longest_claim.as_secs_f64() * 1e3,
            self.total.as_secs_f64()
        )?;
        writeln!(
            f,
            "simulated: {:.0} s, ideally {:.0} s ({:.3}); running jobs of equal projects differ by at most {}",
            seconds(self.makespan_micros),
            seconds(self.ideal_micros),
            self.makespan_micros as f64 / self.ideal_micros as f64,
            self.greatest_spread
        )?;
        writeln!(
            f,
            "{:12} {:>8} {:>9} {:>6} {:>12} {:>12} {:>12}",
            "project", "jobs", "priority", "cap", "median wait", "95 % wait", "longest"
        )?;
        for share in &PROJECTS {
            let waits = &self.waits[share.name];
            let at = |part: f64| seconds(waits[((waits.len() - 1) as f64 * part) as usize]);
            let cap = share.cap.map_or("-".to_owned(), |part| (workers / part).max(1).to_string());
            writeln!(
                f,
                "{:12} {:>8} {:>9} {cap:>6} {:>10.0} s {:>10.0} s {:>10.0} s",
                share.name,
                waits.len(),
                share.priority,
                at(0.5),
                at(0.95),
                at(1.0)
            )?;
        }
        Ok(())
    }
}
