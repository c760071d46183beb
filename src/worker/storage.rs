//! Disk errors as a job's owner sees them: without the server's paths, which only the log contains.

use crate::{
    domain::{Problem, ProblemType},
    store::{BlobError, Outcome, is_disk_full},
};

/// The outcome of an attempt whose blobs cannot be read or written.
pub(super) fn outcome(error: &BlobError) -> Outcome {
    tracing::error!(error = error as &dyn std::error::Error, "{error}");
    if is_disk_full(error) {
        Outcome::Held(full())
    } else if error.is_transient() {
        Outcome::Held(unreachable())
    } else {
        Outcome::Retry(failed())
    }
}

/// The problem of a run without the server's paths; logs the full one.
pub(super) fn redacted(problem: Problem) -> Problem {
    if problem.is(ProblemType::StorageFull) {
        tracing::warn!("the job is held: {problem}");
        full()
    } else if problem.is(ProblemType::StorageFailed) {
        tracing::error!("{problem}");
        failed()
    } else {
        problem
    }
}

fn full() -> Problem {
    let detail = "the service's disk is full; the job continues once there is space";
    Problem::new(ProblemType::StorageFull, detail)
}

fn unreachable() -> Problem {
    let detail = "the service's bucket does not answer, or refuses; the job continues once it does";
    Problem::new(ProblemType::Busy, detail)
}

fn failed() -> Problem {
    Problem::new(ProblemType::StorageFailed, "the job's files cannot be read or written")
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;
    use crate::store::BucketUrl;

    #[test]
    fn a_full_disk_or_a_bucket_that_is_away_holds_the_job_and_other_errors_cost_an_attempt() {
        for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded] {
            let Outcome::Held(problem) = outcome(&BlobError::Io(kind.into())) else { panic!("not held") };
            assert_eq!((problem.status, &*problem.kind), (507, "urn:tcgs:problem:storage-full"));
        }
        let bucket: BucketUrl = "s3://bucket".parse().expect("an address");
        let unusable = [("AWS_CONDITIONAL_PUT".to_owned(), "nonsense".to_owned())];
        let away = bucket.connect_with(unusable).expect_err("no such setting");
        let Outcome::Held(problem) = outcome(&away) else { panic!("not held") };
        assert_eq!((problem.status, &*problem.kind), (503, "urn:tcgs:problem:busy"));
        let broken = outcome(&BlobError::Io(io::ErrorKind::PermissionDenied.into()));
        assert!(matches!(broken, Outcome::Retry(problem) if problem.kind.ends_with("storage-failed")));
    }

    #[test]
    fn paths_of_the_server_are_not_shown() {
        for kind in [ProblemType::StorageFull, ProblemType::StorageFailed] {
            let problem = Problem::new(kind, "no room in /srv/tcgs/data for 3 bytes");
            let redacted = redacted(problem.clone());
            assert_eq!(redacted.kind, problem.kind);
            assert!(!redacted.detail.contains("/srv"), "{redacted}");
        }
        let other = Problem::new(ProblemType::DatasetRejected, "images/a.png is no image");
        assert_eq!(redacted(other.clone()), other);
    }
}
