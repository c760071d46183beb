//! API keys, of which only hashes are kept.
//!
//! Invariant: a key stays in the table, revoked or not. So a service that once had keys never runs as one without.

use jiff::Timestamp;
use serde::Serialize;
use thiserror::Error;
use uuid::Builder;

use super::StoreFuture;
use crate::domain::{ApiKey, KeyHash, KeyId, KeyLimits, MAX_PRIORITY, RandomError, RandomSource, Scope};

/// Longest name of a key, in characters.
const MAX_NAME: usize = 100;

/// A key to be added.
#[derive(Debug, Clone)]
pub struct NewKey {
    /// Its identity, chosen by the caller; keys are listed in the order of these.
    pub id: KeyId,
    /// Its name.
    pub name: String,
    /// The part of the key that may be shown.
    pub prefix: String,
    /// Hash of the key.
    pub hash: KeyHash,
    /// What its holder may do.
    pub scopes: Vec<Scope>,
    /// Its limits.
    pub limits: KeyLimits,
}

/// Why a key cannot be created.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum NewKeyError {
    /// The name is empty, too long or has control characters.
    #[error("a key's name has 1 to {MAX_NAME} characters, none of them a control character")]
    Name,
    /// It has no scope.
    #[error("a key needs at least one scope")]
    NoScopes,
    /// The database cannot store the number.
    #[error("max_bytes: {0} is above the maximum of 9223372036854775807")]
    MaxBytes(u64),
    /// The priority is out of range.
    #[error("max_priority: {0} is outside -{MAX_PRIORITY}..={MAX_PRIORITY}")]
    MaxPriority(i32),
    /// No random bytes could be drawn.
    #[error(transparent)]
    RandomSource(#[from] RandomError),
}

impl NewKey {
    /// Generates a key. The key itself is returned here only; the store keeps its hash.
    ///
    /// # Errors
    /// [`NewKeyError`].
    pub fn generate(
        entropy: &dyn RandomSource,
        now: Timestamp,
        name: &str,
        scopes: &[Scope],
        limits: KeyLimits,
    ) -> Result<(Self, ApiKey), NewKeyError> {
        let name = name.trim();
        if name.is_empty() || name.chars().count() > MAX_NAME || name.chars().any(char::is_control) {
            return Err(NewKeyError::Name);
        }
        let scopes: Vec<Scope> = Scope::ALL.into_iter().filter(|scope| scopes.contains(scope)).collect();
        if scopes.is_empty() {
            return Err(NewKeyError::NoScopes);
        }
        if let Some(bytes) = limits.quota_bytes.filter(|bytes| i64::try_from(*bytes).is_err()) {
            return Err(NewKeyError::MaxBytes(bytes));
        }
        if let Some(priority) =
            limits.max_priority.filter(|max| !(-MAX_PRIORITY..=MAX_PRIORITY).contains(max))
        {
            return Err(NewKeyError::MaxPriority(priority));
        }
        let mut tail = [0; 10];
        entropy.fill(&mut tail)?;
        let millis = u64::try_from(now.as_millisecond()).unwrap_or(0);
        let id = KeyId(Builder::from_unix_timestamp_millis(millis, &tail).into_uuid());
        let key = ApiKey::generate(entropy)?;
        let prefix = key.prefix().to_owned();
        Ok((Self { id, name: name.to_owned(), prefix, hash: key.hash(), scopes, limits }, key))
    }
}

/// A key as it stands, and as the API shows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct KeyRecord {
    /// As in [`NewKey::id`].
    pub id: KeyId,
    /// As in [`NewKey::name`].
    pub name: String,
    /// As in [`NewKey::prefix`].
    pub prefix: String,
    /// As in [`NewKey::scopes`].
    pub scopes: Vec<Scope>,
    /// As in [`NewKey::limits`].
    #[serde(flatten)]
    pub limits: KeyLimits,
    /// Creation.
    pub created_at: Timestamp,
    /// Its last use, to about a minute.
    pub last_used_at: Option<Timestamp>,
    /// When it was revoked, if it was.
    pub revoked_at: Option<Timestamp>,
}

impl KeyRecord {
    /// Whether its holder may do what needs `scope`.
    #[must_use]
    pub fn allows(&self, scope: Scope) -> bool {
        self.scopes.contains(&scope) || self.is_admin()
    }

    /// Whether its holder may do everything.
    #[must_use]
    pub fn is_admin(&self) -> bool {
        self.scopes.contains(&Scope::Admin)
    }
}

/// The part of a store that keeps keys. Every method is one transaction.
pub trait Keys: Send + Sync + 'static {
    /// Adds a key.
    fn create_key(&self, new: NewKey) -> StoreFuture<'_, KeyRecord>;

    /// A key, revoked or not.
    fn key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>>;

    /// Up to `limit` keys, newest first, older than `before`; revoked ones only if they are asked for.
    fn keys(&self, with_revoked: bool, before: Option<KeyId>, limit: u32) -> StoreFuture<'_, Vec<KeyRecord>>;

    /// Revokes a key from the next request on, and returns it; `None` if there is no such key. No change if it is already
    /// revoked.
    fn revoke_key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>>;

    /// The key with this hash, unless it is revoked.
    fn authenticate(&self, hash: KeyHash) -> StoreFuture<'_, Option<KeyRecord>>;

    /// Whether there is a key, revoked or not.
    fn has_keys(&self) -> StoreFuture<'_, bool>;

    /// Records a use of the key.
    fn touch_key(&self, id: KeyId) -> StoreFuture<'_, ()>;
}
