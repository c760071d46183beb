//! One part of an upload on its way to disk.
//!
//! Received bytes are kept however the request ends: they are synced to disk, and only then recorded as received. The exception is
//! a part with a checksum: unless it is complete and matches, none of it counts.

use std::time::Duration;

use axum::body::BodyDataStream;
use tokio::time::Instant;

use super::{expiry, gone, tus::Checksum};
use crate::{
    domain::{ProblemType, ProjectId},
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::Pieces,
        shared::DiskReservation,
        state::AppState,
    },
    store::{UploadFile, UploadRecord},
};

/// Most bytes received but not recorded, and for how long.
const SAVE_BYTES: u64 = 16 << 20;
const SAVE_TIME: Duration = Duration::from_secs(10);

/// A part that may be written.
pub(crate) struct Part {
    record: UploadRecord,
    file: UploadFile,
    checksum: Option<Checksum>,
    /// Bytes of the upload that the file has.
    written: u64,
    _room: Option<DiskReservation>,
}

/// Reserves room on the local disk for what is there of a part of `bytes` on its way to a bucket.
///
/// # Errors
/// 507 if there is none.
pub(crate) async fn reserve(state: &AppState, bytes: u64, has_checksum: bool) -> ApiResult<DiskReservation> {
    let at_a_time = if has_checksum { bytes } else { bytes.min(SAVE_BYTES) };
    state.reservations.reserve_disk(at_a_time).await
}

impl Part {
    /// The next part of a locked upload.
    pub(crate) async fn new(
        record: UploadRecord,
        mut file: UploadFile,
        checksum: Option<Checksum>,
        room: Option<DiskReservation>,
    ) -> ApiResult<Self> {
        file.continue_at(record.received).await?;
        Ok(Self { written: record.received, record, file, checksum, _room: room })
    }

    /// The upload's project.
    pub(crate) fn project(&self) -> ProjectId {
        self.record.project
    }

    /// Writes the body, and returns the upload as it then is.
    ///
    /// # Errors
    /// 413 for more than was announced, 460 for another checksum than announced, 410 if the upload is over, 507, errors of the body.
    pub(crate) async fn receive(
        mut self,
        state: &AppState,
        body: &mut BodyDataStream,
    ) -> ApiResult<UploadRecord> {
        let poured = self.pour(state, body).await;
        match &self.checksum {
            None => {
                let saved = self.save(state).await;
                poured.and(saved)?;
            }
            Some(checksum) => {
                let good = checksum.matches();
                if poured.is_err() || !good {
                    self.file.continue_at(self.record.received).await?;
                }
                poured?;
                if !good {
                    return Err(mismatch(&self.record));
                }
                self.save(state).await?;
            }
        }
        Ok(self.record)
    }

    async fn pour(&mut self, state: &AppState, body: &mut BodyDataStream) -> ApiResult<()> {
        let mut pieces = Pieces::new(body, &state.limits);
        let mut saved_at = Instant::now();
        while let Some(piece) = pieces.next().await? {
            let left = self.record.length - self.written;
            if piece.len() as u64 > left {
                return Err(ProblemResponse::too_large(self.record.length - self.record.received));
            }
            if let Some(checksum) = &mut self.checksum {
                checksum.update(&piece);
            }
            self.file.write(&piece).await?;
            self.written += piece.len() as u64;
            let due = self.written - self.record.received >= SAVE_BYTES || saved_at.elapsed() >= SAVE_TIME;
            if due && self.checksum.is_none() {
                self.save(state).await?;
                saved_at = Instant::now();
            }
        }
        Ok(())
    }

    /// Makes what was written durable and records it.
    async fn save(&mut self, state: &AppState) -> ApiResult<()> {
        let expires_at = expiry(state).await?;
        if !self.file.save(state.store(), self.written, expires_at).await? {
            return Err(gone(self.record.id));
        }
        (self.record.received, self.record.expires_at) = (self.written, expires_at);
        Ok(())
    }
}

fn mismatch(record: &UploadRecord) -> ProblemResponse {
    ProblemType::ChecksumMismatch.because(format!(
        "the part does not have the sum that Upload-Checksum announced; send it again from byte {}",
        record.received
    ))
}
