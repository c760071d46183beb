//! Callers, scopes, projects and their limits.
//!
//! What is stored belongs to a project: every key of that project may see it, and administrators see everything. While a service has no
//! keys, every caller is [`Caller::ANONYMOUS`], who creates in [`ProjectId::DEFAULT`] and may do everything.

use serde::{Deserialize, Serialize};

use super::{KeyId, ProjectId, ShareId, named_choice};

named_choice! {
    /// What a key allows.
    pub enum Scope {
        /// See datasets, jobs, files and views.
        Read = "read",
        /// Send and delete datasets. Also read as `datasets:write`.
        #[serde(alias = "datasets:write")]
        DatasetsWrite = "scenes:write",
        /// Make, cancel and delete jobs.
        JobsWrite = "jobs:write",
        /// Everything, of every project.
        Admin = "admin",
    }
}

/// Limits of a project; absent ones are unlimited, except for the priority.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ProjectLimits {
    /// Bytes of storage for its scenes, uploads and jobs.
    #[serde(rename = "max_bytes")]
    pub quota_bytes: Option<u64>,
    /// Jobs queued or running at the same time.
    pub max_active_jobs: Option<u32>,
    /// Jobs running at the same time; more wait, even if workers are idle.
    pub max_running_jobs: Option<u32>,
    /// Highest priority of its jobs. Where it is absent, [`DEFAULT_MAX_PRIORITY`].
    pub max_priority: Option<i32>,
}

/// Highest priority of the jobs of a project without a limit of its own; administrators have none.
pub const DEFAULT_MAX_PRIORITY: i32 = 0;

/// Highest priority of any job, and the lowest with the other sign.
pub const MAX_PRIORITY: i32 = 100;

impl ProjectLimits {
    /// These limits, with absent ones from `default`.
    #[must_use]
    pub fn or(self, default: Self) -> Self {
        Self {
            quota_bytes: self.quota_bytes.or(default.quota_bytes),
            max_active_jobs: self.max_active_jobs.or(default.max_active_jobs),
            max_running_jobs: self.max_running_jobs.or(default.max_running_jobs),
            max_priority: self.max_priority.or(default.max_priority),
        }
    }
}

/// What a request is admitted by. Places that each caller may take are counted by it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Credential {
    /// Nothing: the service has no keys.
    None,
    /// A key.
    Key(KeyId),
    /// A shared link.
    Link(ShareId),
}

/// The sender of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Caller {
    /// Its key; `None` while the service has no keys, and for a link's holder.
    pub key: Option<KeyId>,
    /// The shared link that it came by.
    pub link: Option<ShareId>,
    /// The project that it creates in.
    pub project: ProjectId,
    /// Whether it may see and do everything.
    pub admin: bool,
}

impl Caller {
    /// The caller of a service without keys.
    pub const ANONYMOUS: Self = Self { key: None, link: None, project: ProjectId::DEFAULT, admin: true };

    /// What the request was admitted by.
    #[must_use]
    pub fn credential(&self) -> Credential {
        match (self.key, self.link) {
            (Some(key), _) => Credential::Key(key),
            (None, Some(link)) => Credential::Link(link),
            (None, None) => Credential::None,
        }
    }

    /// Whether this caller may see what belongs to `project`.
    #[must_use]
    pub fn may_see(&self, project: ProjectId) -> bool {
        self.admin || self.project == project
    }

    /// The project that lists are restricted to; `None` for no restriction.
    #[must_use]
    pub fn visible_project(&self) -> Option<ProjectId> {
        (!self.admin).then_some(self.project)
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn a_caller_sees_its_project_and_an_administrator_everything() {
        let key = KeyId(Uuid::from_u128(9));
        let [one, other] = [1, 2].map(|id| ProjectId(Uuid::from_u128(id)));
        let caller = Caller { key: Some(key), link: None, project: one, admin: false };
        assert!(caller.may_see(one));
        assert!(!caller.may_see(other));
        assert!(!caller.may_see(ProjectId::DEFAULT), "what was made without a key is another project's");
        assert_eq!(caller.visible_project(), Some(one));
        for all in [Caller::ANONYMOUS, Caller { admin: true, ..caller }] {
            assert!(all.may_see(other) && all.may_see(ProjectId::DEFAULT));
            assert_eq!(all.visible_project(), None);
        }
    }

    #[test]
    fn holders_of_two_links_are_two_callers() {
        let by = |link: u128| Caller {
            key: None,
            link: Some(ShareId(Uuid::from_u128(link))),
            project: ProjectId::DEFAULT,
            admin: false,
        };
        assert_eq!(by(1).credential(), by(1).credential());
        assert_ne!(by(1).credential(), by(2).credential());
        assert_eq!(Caller::ANONYMOUS.credential(), Credential::None);
    }

    #[test]
    fn scopes_have_names_that_can_be_read_back() {
        for scope in Scope::ALL {
            assert_eq!(scope.name().parse(), Ok(scope));
            assert_eq!(serde_json::to_value(scope).expect("a string"), scope.name());
        }
        let error = "write".parse::<Scope>().expect_err("no scope");
        assert!(error.contains("scenes:write"), "{error}");
    }
}
