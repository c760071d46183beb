//! Ends this process where a test wants it to. `TCGS_FAIL_AT` names a file: while it holds `POINT:N`, the process that reaches that point for
//! the N-th time since then removes it and aborts. So of a service and its workers one dies, once. Only in builds with debug assertions.

use std::{
    env, fs,
    path::PathBuf,
    process,
    sync::{Mutex, OnceLock, PoisonError},
};

use tcgs::domain::{FailurePoint, failure_point};

static PLAN: OnceLock<PathBuf> = OnceLock::new();
/// The plan that was read last, and how many times its point was reached.
static VISITS: Mutex<(String, u32)> = Mutex::new((String::new(), 0));

/// Reads plans from the file that the environment names, if it names one.
pub(super) fn follow_plan() {
    if let Some(path) = env::var_os("TCGS_FAIL_AT")
        && PLAN.set(path.into()).is_ok()
    {
        failure_point::plan(fail_at);
    }
}

fn fail_at(point: FailurePoint) {
    let Some(path) = PLAN.get() else { return };
    let Ok(plan) = fs::read_to_string(path) else { return };
    let Some(visit) = visit_of(&plan, point) else { return };
    let mut visits = VISITS.lock().unwrap_or_else(PoisonError::into_inner);
    if visits.0 != plan {
        *visits = (plan, 0);
    }
    visits.1 += 1;
    // Of two processes that reach it at the same time, one removes the file.
    if visits.1 == visit && fs::remove_file(path).is_ok() {
        process::abort();
    }
}

/// The visit of the point that a plan names, from 1; `None` if the plan is another point's.
fn visit_of(plan: &str, point: FailurePoint) -> Option<u32> {
    let (name, visit) = plan.trim().split_once(':')?;
    if name == point.name() { visit.parse().ok() } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_is_a_point_and_a_visit() {
        assert_eq!(visit_of("step:17\n", FailurePoint::Step), Some(17));
        for plan in ["", "step", "step:", "step:x", "ingest:17"] {
            assert_eq!(visit_of(plan, FailurePoint::Step), None, "{plan}");
        }
    }
}
