//! Callers, scopes, ownership and the limits of keys.
//!
//! What has an owner is visible to that owner and to administrators only. While a service has no keys, every caller is
//! [`Caller::ANONYMOUS`], who owns nothing and may do everything.

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use super::{KeyId, choice::named_choice};

named_choice! {
    /// What a key allows.
    Scope {
        /// See scenes, jobs, files and views.
        Read = "read",
        /// Send and delete scenes.
        ScenesWrite = "scenes:write",
        /// Make, cancel and delete jobs.
        JobsWrite = "jobs:write",
        /// Everything, of every owner.
        Admin = "admin",
    }
}

/// Limits of a key; absent ones are unlimited, except for the priority.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyLimits {
    /// Bytes of storage for its scenes, uploads and jobs.
    #[serde(rename = "max_bytes")]
    pub quota_bytes: Option<u64>,
    /// Jobs queued or running at the same time.
    pub max_active_jobs: Option<u32>,
    /// Requests per minute, which may all come at once.
    pub requests_per_minute: Option<NonZeroU32>,
    /// Highest priority of its jobs. Where it is absent, [`DEFAULT_MAX_PRIORITY`].
    pub max_priority: Option<i32>,
}

/// Highest priority of the jobs of a key without a limit of its own; administrators have none.
pub const DEFAULT_MAX_PRIORITY: i32 = 0;

/// Highest priority of any job, and the lowest with the other sign.
pub const MAX_PRIORITY: i32 = 100;

impl KeyLimits {
    /// These limits, with absent ones from `default`.
    #[must_use]
    pub fn or(self, default: Self) -> Self {
        Self {
            quota_bytes: self.quota_bytes.or(default.quota_bytes),
            max_active_jobs: self.max_active_jobs.or(default.max_active_jobs),
            requests_per_minute: self.requests_per_minute.or(default.requests_per_minute),
            max_priority: self.max_priority.or(default.max_priority),
        }
    }
}

/// The sender of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Caller {
    /// Its key; `None` while the service has no keys.
    pub key: Option<KeyId>,
    /// Whether it may see and do everything.
    pub admin: bool,
}

impl Caller {
    /// The caller of a service without keys.
    pub const ANONYMOUS: Self = Self { key: None, admin: true };

    /// Whether this caller may see what belongs to `owner`.
    #[must_use]
    pub fn may_see(&self, owner: Option<KeyId>) -> bool {
        self.admin || (self.key.is_some() && self.key == owner)
    }

    /// The owner that lists are restricted to; `None` for no restriction.
    #[must_use]
    pub fn visible_owner(&self) -> Option<KeyId> {
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
        assert_eq!(caller.visible_owner(), Some(one));
        for all in [Caller::ANONYMOUS, Caller { key: Some(one), admin: true }] {
            assert!(all.may_see(Some(other)) && all.may_see(None));
            assert_eq!(all.visible_owner(), None);
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
