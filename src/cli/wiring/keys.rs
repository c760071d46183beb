//! Projects and keys in the database of a service, whether it runs or not.

use tcgs::{
    domain::{
        ApiKey, Clock as _, KeyId, Problem, ProblemType, ProjectId, ProjectLimits, SystemClock, SystemRandom,
    },
    store::{
        KeyChange, KeyRecord, KeyRequest, NewKey, NewProject, ProjectChange, ProjectRecord, ProjectUpdate,
        ProjectUsage, Store, StoreError,
    },
};

use super::{
    runtime::{runtime, unavailable},
    service::{OlderSchema, open_store},
};
use crate::cli::{CliError, notice::notice, storage::Storage};

/// Keys per page of the list.
const PAGE: u32 = 1000;

/// What a service without keys has, before its first one.
#[derive(Debug, Default)]
pub(crate) struct WithoutKeys {
    /// Whether there is a database without any key, of which requests need none.
    pub(crate) is_open: bool,
    /// Jobs that were made without a key.
    pub(crate) jobs: u64,
}

/// What there is without keys; nothing where there is no database yet.
pub(crate) fn without_keys(storage: &Storage) -> Result<WithoutKeys, CliError> {
    if storage.lacks_database() {
        return Ok(WithoutKeys::default());
    }
    with_store(storage, async |store| {
        if !store.keys(None, true, None, 1).await?.is_empty() {
            return Ok(WithoutKeys::default());
        }
        let usage = store.project_usage(Some(ProjectId::DEFAULT), None, 1).await?;
        let jobs = usage.iter().flat_map(|usage| &usage.jobs).map(|(_, count)| count).sum();
        Ok(WithoutKeys { is_open: true, jobs })
    })
}

/// Creates a key.
pub(crate) fn create_key(
    storage: &Storage,
    request: KeyRequest<'_>,
) -> Result<(KeyRecord, ApiKey), CliError> {
    let drawn = NewKey::generate(&SystemRandom, SystemClock.now(), request);
    let (new, key) = drawn.map_err(|error| CliError::Usage(error.to_string()))?;
    let record = with_new_store(storage, async |store| match store.create_key(new).await {
        Err(StoreError::NoProject(id)) => Ok(Err(id)),
        created => created.map(Ok),
    })?;
    Ok((record.map_err(|id| no_project(storage, id))?, key))
}

/// Changes a key.
pub(crate) fn change_key(storage: &Storage, id: KeyId, change: KeyChange) -> Result<KeyRecord, CliError> {
    let found = with_store(storage, async |store| store.key(id).await)?;
    let record = found.filter(|key| key.revoked_at.is_none()).ok_or_else(|| no_key(storage, id))?;
    let change =
        change.checked(&record, SystemClock.now()).map_err(|error| CliError::Usage(error.to_string()))?;
    let changed = with_store(storage, async |store| store.update_key(id, change).await)?;
    changed.ok_or_else(|| no_key(storage, id))
}

/// The keys of a project or of all, newest first, with revoked ones if `with_revoked`.
pub(crate) fn keys(
    storage: &Storage,
    project: Option<ProjectId>,
    with_revoked: bool,
) -> Result<Vec<KeyRecord>, CliError> {
    with_store(storage, async |store| {
        let mut all: Vec<KeyRecord> = Vec::new();
        loop {
            let page = store.keys(project, with_revoked, all.last().map(|key| key.id), PAGE).await?;
            if page.is_empty() {
                return Ok(all);
            }
            all.extend(page);
        }
    })
}

/// Revokes a key.
pub(crate) fn revoke_key(storage: &Storage, id: KeyId) -> Result<KeyRecord, CliError> {
    let revoked = with_store(storage, async |store| store.revoke_key(id).await)?;
    revoked.ok_or_else(|| no_key(storage, id))
}

fn no_key(storage: &Storage, id: KeyId) -> CliError {
    let detail = format!("there is no key {id} in {storage}; see 'tcgs keys list --all'");
    Problem::new(ProblemType::KeyNotFound, detail).into()
}

fn no_project(storage: &Storage, id: ProjectId) -> CliError {
    let detail = format!("there is no project {id} in {storage}; see 'tcgs projects list'");
    Problem::new(ProblemType::ProjectNotFound, detail).into()
}

/// Creates a project.
pub(crate) fn create_project(
    storage: &Storage,
    name: &str,
    limits: ProjectLimits,
) -> Result<ProjectRecord, CliError> {
    let new = NewProject::generate(&SystemRandom, SystemClock.now(), name, limits);
    let new = new.map_err(|error| CliError::Usage(error.to_string()))?;
    with_new_store(storage, async |store| store.create_project(new).await)
}

/// Changes a project.
pub(crate) fn change_project(
    storage: &Storage,
    id: ProjectId,
    change: impl Fn(&ProjectRecord) -> ProjectChange,
) -> Result<ProjectRecord, CliError> {
    loop {
        let found = with_store(storage, async |store| store.project(id).await)?;
        let record = found.ok_or_else(|| no_project(storage, id))?;
        let change = change(&record).checked().map_err(|error| CliError::Usage(error.to_string()))?;
        let version = Some(record.version);
        match with_store(storage, async |store| store.update_project(id, version, change).await)? {
            None => return Err(no_project(storage, id)),
            Some(ProjectUpdate::Updated(record)) => return Ok(record),
            // Changed over HTTP meanwhile.
            Some(ProjectUpdate::VersionMismatch) => {}
        }
    }
}

/// The projects with their usage, newest first.
pub(crate) fn projects(storage: &Storage) -> Result<Vec<ProjectUsage>, CliError> {
    with_store(storage, async |store| {
        let mut all: Vec<ProjectUsage> = Vec::new();
        loop {
            let page = store.project_usage(None, all.last().map(|usage| usage.project.id), PAGE).await?;
            if page.is_empty() {
                return Ok(all);
            }
            all.extend(page);
        }
    })
}

/// Like [`with_store`], with a new database where there is none: keys are made before a service first starts.
fn with_new_store<T>(
    storage: &Storage,
    work: impl AsyncFnOnce(&Store) -> Result<T, StoreError>,
) -> Result<T, CliError> {
    let new = storage.lacks_database();
    let outcome = with_opened(storage, work)?;
    if new {
        notice(format_args!("tcgs: note: there was no database in {storage}; it is new"));
    }
    Ok(outcome)
}

/// Does `work` with a database that must be there.
fn with_store<T>(
    storage: &Storage,
    work: impl AsyncFnOnce(&Store) -> Result<T, StoreError>,
) -> Result<T, CliError> {
    storage.expect_database()?;
    with_opened(storage, work)
}

fn with_opened<T>(
    storage: &Storage,
    work: impl AsyncFnOnce(&Store) -> Result<T, StoreError>,
) -> Result<T, CliError> {
    runtime()?.block_on(async {
        // A service of another version may be using it.
        let store = open_store(storage, ProjectLimits::default(), OlderSchema::Refuse).await?;
        let outcome = work(&store).await;
        store.close().await;
        outcome.map_err(|error| unavailable(&error))
    })
}
