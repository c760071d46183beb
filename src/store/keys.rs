//! API keys, of which only hashes are kept.
//!
//! Invariant: a key stays in the table, revoked or not. So a service that once had keys never runs as one without.

use std::num::NonZeroU32;

use jiff::Timestamp;
use serde::Serialize;
use thiserror::Error;
use uuid::Builder;

use super::{NewProject, ProjectError};
use crate::domain::{
    ApiKey, KeyHash, KeyId, MAX_NAME, ProjectId, ProjectLimits, RandomError, RandomSource, Scope, valid_name,
};

/// The project of a key to be added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum KeyProject<New = ProjectLimits> {
    /// One that there is.
    Existing(ProjectId),
    /// One of its own, with the key's name.
    New(New),
}

impl Default for KeyProject {
    fn default() -> Self {
        Self::New(ProjectLimits::default())
    }
}

/// What a key is to be.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct KeyRequest<'a> {
    pub name: &'a str,
    /// What its holder may do.
    pub scopes: &'a [Scope],
    /// Its project, or the limits of one of its own.
    pub project: KeyProject,
    /// When it ceases to be valid.
    pub expires_at: Option<Timestamp>,
    /// Requests per minute, which may all come at once.
    pub requests_per_minute: Option<NonZeroU32>,
}

/// A key to be added.
#[derive(Debug, Clone)]
pub struct NewKey {
    /// Its identity, chosen by the caller; keys are listed in the order of these.
    pub id: KeyId,
    pub project: KeyProject<NewProject>,
    pub name: String,
    /// The part of the key that may be shown.
    pub prefix: String,
    pub hash: KeyHash,
    /// What its holder may do.
    pub scopes: Vec<Scope>,
    /// As in [`KeyRequest::requests_per_minute`].
    pub requests_per_minute: Option<NonZeroU32>,
    /// As in [`KeyRequest::expires_at`].
    pub expires_at: Option<Timestamp>,
}

/// Why a key cannot be created or changed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum NewKeyError {
    /// The name is empty, too long or has control characters.
    #[error("a key's name has 1 to {MAX_NAME} characters, none of them a control character")]
    Name,
    /// It has no scope.
    #[error("a key needs at least one scope")]
    NoScopes,
    /// It would have expired already.
    #[error("expires_at: {0} has passed")]
    Expired(Timestamp),
    /// Its project cannot be created.
    #[error(transparent)]
    Project(#[from] ProjectError),
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
        request: KeyRequest<'_>,
    ) -> Result<(Self, ApiKey), NewKeyError> {
        let key = ApiKey::generate(entropy)?;
        Ok((Self::of(&key, entropy, now, request)?, key))
    }

    /// A key that there is already, to be added.
    ///
    /// # Errors
    /// [`NewKeyError`].
    pub fn of(
        key: &ApiKey,
        entropy: &dyn RandomSource,
        now: Timestamp,
        request: KeyRequest<'_>,
    ) -> Result<Self, NewKeyError> {
        let name = valid_name(request.name).ok_or(NewKeyError::Name)?.to_owned();
        let scopes: Vec<Scope> =
            Scope::ALL.into_iter().filter(|scope| request.scopes.contains(scope)).collect();
        if scopes.is_empty() {
            return Err(NewKeyError::NoScopes);
        }
        expect_future(request.expires_at, now)?;
        let project = match request.project {
            KeyProject::Existing(id) => KeyProject::Existing(id),
            KeyProject::New(limits) => KeyProject::New(NewProject::generate(entropy, now, &name, limits)?),
        };
        let mut tail = [0; 10];
        entropy.fill(&mut tail)?;
        let millis = u64::try_from(now.as_millisecond()).unwrap_or(0);
        let id = KeyId(Builder::from_unix_timestamp_millis(millis, &tail).into_uuid());
        let KeyRequest { requests_per_minute, expires_at, .. } = request;
        let (prefix, hash) = (key.prefix().to_owned(), key.hash());
        Ok(Self { id, project, name, prefix, hash, scopes, requests_per_minute, expires_at })
    }
}

fn expect_future(expires_at: Option<Timestamp>, now: Timestamp) -> Result<(), NewKeyError> {
    match expires_at.filter(|at| *at <= now) {
        Some(at) => Err(NewKeyError::Expired(at)),
        None => Ok(()),
    }
}

/// What changes of a key; fields that are `None` stay as they are when the change is made.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct KeyChange {
    pub name: Option<String>,
    /// As in [`KeyRequest::requests_per_minute`].
    pub requests_per_minute: Option<Option<NonZeroU32>>,
    /// As in [`KeyRequest::expires_at`].
    pub expires_at: Option<Option<Timestamp>>,
}

impl KeyChange {
    /// The change of `record`, if it can be stored. An expiry in the past is refused unless it is the one that the key has.
    ///
    /// # Errors
    /// [`NewKeyError`].
    pub fn checked(self, record: &KeyRecord, now: Timestamp) -> Result<Self, NewKeyError> {
        let valid = |name: String| valid_name(&name).map(str::to_owned).ok_or(NewKeyError::Name);
        let name = self.name.map(valid).transpose()?;
        if let Some(expires_at) = self.expires_at
            && expires_at != record.expires_at
        {
            expect_future(expires_at, now)?;
        }
        Ok(Self { name, ..self })
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
    pub project_id: ProjectId,
    /// As in [`KeyRequest::requests_per_minute`].
    pub requests_per_minute: Option<NonZeroU32>,
    pub created_at: Timestamp,
    /// Its last use, to about a minute.
    pub last_used_at: Option<Timestamp>,
    /// As in [`KeyRequest::expires_at`].
    pub expires_at: Option<Timestamp>,
    /// When it was revoked, if it was.
    pub revoked_at: Option<Timestamp>,
}

impl KeyRecord {
    /// Whether it is neither revoked nor expired.
    #[must_use]
    pub fn is_valid(&self, now: Timestamp) -> bool {
        self.revoked_at.is_none() && self.expires_at.is_none_or(|at| now < at)
    }

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
