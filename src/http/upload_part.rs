//! One part of an upload on its way to disk.
//!
//! What has come stays, however the request ends: it is brought to disk, and only then is it recorded as received. A part with a
//! checksum is the exception: unless the whole of it came and hashes to the sum, none of it counts.

use std::time::Duration;

use axum::{body::BodyDataStream, http::StatusCode};
use tokio::time::Instant;

use super::{
    body::Pieces,
    problem::Fault,
    state::AppState,
    tus::Checksum,
    uploads::{expiry, gone},
};
use crate::store::{UploadFile, UploadRecord};

/// How much may have come without being recorded, and for how long.
const SAVE_BYTES: u64 = 16 << 20;
const SAVE_TIME: Duration = Duration::from_secs(10);

/// A part that may be written.
pub(super) struct Part {
    record: UploadRecord,
    file: UploadFile,
    checksum: Option<Checksum>,
    /// Bytes of the upload that the file has.
    written: u64,
}

impl Part {
    /// The part that comes next; whoever makes it holds the file.
    pub(super) async fn new(
        record: UploadRecord,
        mut file: UploadFile,
        checksum: Option<Checksum>,
    ) -> Result<Self, Fault> {
        file.continue_at(record.received).await?;
        Ok(Self { written: record.received, record, file, checksum })
    }

    /// Writes the body, and returns the upload as it then is.
    ///
    /// # Errors
    /// 413 for more than was announced, 460 for another sum than was announced, 410 if the upload is over, what is wrong with
    /// the body, 507.
    pub(super) async fn receive(
        mut self,
        state: &AppState,
        body: &mut BodyDataStream,
    ) -> Result<UploadRecord, Fault> {
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

    async fn pour(&mut self, state: &AppState, body: &mut BodyDataStream) -> Result<(), Fault> {
        let mut pieces = Pieces::new(body, state.limits());
        let mut saved_at = Instant::now();
        while let Some(piece) = pieces.next().await? {
            let left = self.record.length - self.written;
            if piece.len() as u64 > left {
                return Err(Fault::too_large(self.record.length - self.record.received));
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

    /// Brings what was written to disk and records it.
    async fn save(&mut self, state: &AppState) -> Result<(), Fault> {
        self.file.sync().await?;
        let expires_at = expiry(state);
        if !state.store().advance_upload(self.record.id, self.written, expires_at).await? {
            return Err(gone(self.record.id));
        }
        (self.record.received, self.record.expires_at) = (self.written, expires_at);
        Ok(())
    }
}

fn mismatch(record: &UploadRecord) -> Fault {
    // The protocol's own status, which has no name elsewhere.
    let status = StatusCode::from_u16(460).unwrap_or(StatusCode::BAD_REQUEST);
    Fault::new(
        status,
        "checksum-mismatch",
        "Checksum mismatch",
        format!(
            "the part does not have the sum that Upload-Checksum announced; send it again from byte {}",
            record.received
        ),
    )
}
