//! Who asks, what they may do, and what is theirs.
//!
//! What always holds: what has an owner is seen by that owner and by administrators only. While a service has no keys, everybody is
//! [`Caller::ANYBODY`], who owns nothing and may do everything.

use std::{num::NonZeroU32, str::FromStr};

use serde::{Deserialize, Serialize};

use super::KeyId;

/// What a key lets its holder do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Scope {
    /// See scenes, jobs, files and views.
    #[serde(rename = "read")]
    Read,
    /// Send and delete scenes.
    #[serde(rename = "scenes:write")]
    ScenesWrite,
    /// Make, cancel and delete jobs.
    #[serde(rename = "jobs:write")]
    JobsWrite,
    /// Everything, of every owner.
    #[serde(rename = "admin")]
    Admin,
}

impl Scope {
    /// Every scope.
    pub const ALL: [Self; 4] = [Self::Read, Self::ScenesWrite, Self::JobsWrite, Self::Admin];

    /// The name on the command line, in the database and the API.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Scope::Read => "read",
            Scope::ScenesWrite => "scenes:write",
            Scope::JobsWrite => "jobs:write",
            Scope::Admin => "admin",
        }
    }
}

impl FromStr for Scope {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|scope| scope.name() == text).ok_or_else(|| {
            let known: Vec<&str> = Self::ALL.iter().map(|scope| scope.name()).collect();
            format!("'{text}' is not a scope; there are {}", known.join(", "))
        })
    }
}

/// How much a key's holder may take; what is absent is not bounded, but for the priority.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyLimits {
    /// Bytes that its scenes, uploads and jobs may keep in storage.
    pub max_bytes: Option<u64>,
    /// Jobs that may be queued or running at a time.
    pub max_active_jobs: Option<u32>,
    /// Requests in a minute; as many may come at once.
    pub requests_per_minute: Option<NonZeroU32>,
    /// Highest priority of its jobs. Where it is absent, [`DEFAULT_MAX_PRIORITY`].
    pub max_priority: Option<i32>,
}

/// Highest priority of the jobs of a key that neither has a ceiling of its own nor is an administrator's: its jobs take their turn,
/// or stand back.
pub const DEFAULT_MAX_PRIORITY: i32 = 0;

/// Highest priority of any job, and the lowest with the other sign.
pub const MAX_PRIORITY: i32 = 100;

impl KeyLimits {
    /// These limits, and those of `default` where there are none.
    #[must_use]
    pub fn or(self, default: Self) -> Self {
        Self {
            max_bytes: self.max_bytes.or(default.max_bytes),
            max_active_jobs: self.max_active_jobs.or(default.max_active_jobs),
            requests_per_minute: self.requests_per_minute.or(default.requests_per_minute),
            max_priority: self.max_priority.or(default.max_priority),
        }
    }
}

/// Who sent a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Caller {
    /// The key that it came with, none while the service has no keys.
    pub key: Option<KeyId>,
    /// Whether it may see and do everything.
    pub admin: bool,
}

impl Caller {
    /// Whoever asks a service that has no keys.
    pub const ANYBODY: Self = Self { key: None, admin: true };

    /// Whether what belongs to `owner` is there for this caller.
    #[must_use]
    pub fn may_see(&self, owner: Option<KeyId>) -> bool {
        self.admin || (self.key.is_some() && self.key == owner)
    }

    /// Whose things a list shows: everybody's for none.
    #[must_use]
    pub fn sees_only(&self) -> Option<KeyId> {
        self.key.filter(|_| !self.admin)
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn a_caller_sees_its_own_and_an_administrator_everything() {
        let [one, other] = [1, 2].map(|id| KeyId(Uuid::from_u128(id)));
        let caller = Caller { key: Some(one), admin: false };
        assert!(caller.may_see(Some(one)));
        assert!(!caller.may_see(Some(other)));
        assert!(!caller.may_see(None), "what was made without a key is the administrators'");
        assert_eq!(caller.sees_only(), Some(one));
        for all in [Caller::ANYBODY, Caller { key: Some(one), admin: true }] {
            assert!(all.may_see(Some(other)) && all.may_see(None));
            assert_eq!(all.sees_only(), None);
        }
    }

    #[test]
    fn scopes_have_names_that_can_be_read_back() {
        for scope in Scope::ALL {
            assert_eq!(scope.name().parse(), Ok(scope));
            assert_eq!(serde_json::to_value(scope).expect("a string"), scope.name());
        }
        let fault = "write".parse::<Scope>().expect_err("no scope");
        assert!(fault.contains("scenes:write"), "{fault}");
    }
}
