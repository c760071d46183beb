//! Why a job ended without output, and whether another attempt may help.

use crate::{
    domain::{Problem, ProblemType, is_no_space},
    gpu::GpuError,
    ingest::{self, IngestErrorKind},
    render::RenderError,
    train::TrainError,
};

/// Why a job ended without output.
#[derive(Debug, Clone, PartialEq)]
pub enum JobError {
    /// The input or the options are at fault: another attempt cannot help.
    Fail(Problem),
    /// The machine is at fault (device lost): another attempt may succeed.
    Retry(Problem),
    /// Something is missing that time or an operator provides, such as disk space: another attempt will succeed then.
    Hold(Problem),
    /// The cancel flag was set.
    Cancelled,
}

impl JobError {
    /// A fault of this program.
    pub(super) fn internal(detail: impl Into<String>) -> Self {
        Self::Fail(Problem::new(ProblemType::Internal, detail.into()))
    }
}

/// A full disk may have space later, and one that failed may work again; a dataset does not change.
impl From<ingest::IngestError> for JobError {
    fn from(error: ingest::IngestError) -> Self {
        match error.kind {
            IngestErrorKind::Stopped => Self::Cancelled,
            IngestErrorKind::SpillFull { .. } => Self::Hold(error.into()),
            ref kind if is_no_space(kind) => Self::Hold(error.into()),
            IngestErrorKind::Spill(_) | IngestErrorKind::Write(_) => Self::Retry(error.into()),
            IngestErrorKind::Io(ref cause) if cause.raw_os_error().is_some() => Self::Retry(error.into()),
            _ => Self::Fail(error.into()),
        }
    }
}

/// A device that failed may work again; a scene that is too large for it will not shrink.
impl From<GpuError> for JobError {
    fn from(error: GpuError) -> Self {
        match error {
            GpuError::DeviceLost(_) | GpuError::Timeout { .. } | GpuError::Rejected(_) => {
                Self::Retry(error.into())
            }
            GpuError::NoAdapter
            | GpuError::NoMatchingAdapter { .. }
            | GpuError::Open { .. }
            | GpuError::Kernel { .. }
            | GpuError::BufferTooLarge { .. }
            | GpuError::OverBudget { .. } => Self::Fail(error.into()),
        }
    }
}

impl From<RenderError> for JobError {
    fn from(error: RenderError) -> Self {
        match error {
            RenderError::Gpu(error) => error.into(),
            RenderError::Photograph(error) => Self::Retry(error.into()),
            other => Self::Fail(other.into()),
        }
    }
}

impl From<TrainError> for JobError {
    fn from(error: TrainError) -> Self {
        match error {
            TrainError::Cancelled => Self::Cancelled,
            TrainError::Gpu(error) => error.into(),
            TrainError::Render(error) => error.into(),
            TrainError::Photograph(error) => Self::Retry(error.into()),
            other => Self::Fail(other.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[test]
    fn a_full_disk_holds_a_job_and_a_broken_one_costs_it_an_attempt() {
        let spill = |kind: io::ErrorKind| IngestErrorKind::Spill(kind.into());
        let write = |kind: io::ErrorKind| IngestErrorKind::Write(kind.into());
        for (error, expected) in [
            (IngestErrorKind::SpillFull { bytes: 3 }, "hold"),
            (IngestErrorKind::Io(io::ErrorKind::StorageFull.into()), "hold"),
            (IngestErrorKind::Io(io::ErrorKind::QuotaExceeded.into()), "hold"),
            (IngestErrorKind::Io(io::Error::other(io::Error::from(io::ErrorKind::StorageFull))), "hold"),
            (spill(io::ErrorKind::PermissionDenied), "retry"),
            (spill(io::ErrorKind::StorageFull), "hold"),
            (write(io::ErrorKind::PermissionDenied), "retry"),
            (write(io::ErrorKind::StorageFull), "hold"),
            // EIO.
            (IngestErrorKind::Io(io::Error::from_raw_os_error(5)), "retry"),
            (IngestErrorKind::NoImages, "fail"),
            (IngestErrorKind::Io(io::ErrorKind::InvalidData.into()), "fail"),
            (IngestErrorKind::Stopped, "cancelled"),
        ] {
            let message = error.to_string();
            let outcome = match JobError::from(ingest::IngestError::from(error)) {
                JobError::Hold(_) => "hold",
                JobError::Retry(_) => "retry",
                JobError::Fail(_) => "fail",
                JobError::Cancelled => "cancelled",
            };
            assert_eq!(outcome, expected, "{message}");
        }
    }
}
