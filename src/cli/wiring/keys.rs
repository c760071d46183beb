//! Keys in the database of a service, whether it runs or not.

use std::path::Path;

use tcgs::{
    domain::{ApiKey, Clock as _, KeyId, KeyLimits, Problem, ProblemType, Scope, SystemClock, SystemRandom},
    store::{KeyRecord, Keys as _, NewKey, SqliteStore, StoreError},
};

use super::service::{OlderSchema, open_store, runtime, unavailable};
use crate::cli::CliError;

/// Keys per page of the list.
const PAGE: u32 = 1000;

/// Creates a key.
pub(crate) fn create_key(
    data: &Path,
    name: &str,
    scopes: &[Scope],
    limits: KeyLimits,
) -> Result<(KeyRecord, ApiKey), CliError> {
    let drawn = NewKey::generate(&SystemRandom, SystemClock.now(), name, scopes, limits);
    let (new, key) = drawn.map_err(|fault| CliError::Usage(fault.to_string()))?;
    let record = with_store(data, async |store| store.create_key(new).await)?;
    Ok((record, key))
}

/// The keys, newest first, with revoked ones if `with_revoked`.
pub(crate) fn keys(data: &Path, with_revoked: bool) -> Result<Vec<KeyRecord>, CliError> {
    with_store(data, async |store| {
        let mut all: Vec<KeyRecord> = Vec::new();
        loop {
            let page = store.keys(with_revoked, all.last().map(|key| key.id), PAGE).await?;
            if page.is_empty() {
                return Ok(all);
            }
            all.extend(page);
        }
    })
}

/// Revokes a key.
pub(crate) fn revoke_key(data: &Path, id: KeyId) -> Result<KeyRecord, CliError> {
    let revoked = with_store(data, async |store| store.revoke_key(id).await)?;
    revoked.ok_or_else(|| {
        let detail = format!("there is no key {id} in {}; see 'tcgs keys list --all'", data.display());
        Problem::new(ProblemType::KeyNotFound, detail).into()
    })
}

fn with_store<T>(
    data: &Path,
    work: impl AsyncFnOnce(&SqliteStore) -> Result<T, StoreError>,
) -> Result<T, CliError> {
    runtime()?.block_on(async {
        // A service of another version may be using it.
        let store = open_store(data, KeyLimits::default(), OlderSchema::Refuse).await?;
        let outcome = work(&store).await;
        store.close().await;
        outcome.map_err(|fault| unavailable(&fault))
    })
}
