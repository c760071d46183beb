//! Sessions of browsers.

use jiff::Timestamp;

use crate::domain::{KeyHash, KeyId};

/// Sessions that a key may have; one more ends the oldest.
pub const SESSIONS_PER_KEY: u32 = 100;

/// A session to be added.
#[derive(Debug, Clone, Copy)]
pub struct NewSession {
    pub hash: KeyHash,
    /// The key that it stands for.
    pub key: KeyId,
    pub expires_at: Timestamp,
}
