//! `Idempotency-Key`: a request that is sent again makes nothing again.
//!
//! The store remembers what a key made, in the transaction that made it ([`crate::store::Idempotency`]). Which requests are
//! still being answered is known to this process alone and ends with it, so that what a crash cuts off can simply be sent
//! again. Between processes the store decides: of two requests with one key, one makes the thing and the other learns of it.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex, PoisonError},
};

use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use sha2::{Digest as _, Sha256};

use super::{problem::Fault, state::AppState};
use crate::{
    domain::{Caller, Digest, KeyId},
    store::{IdempotentRequest, PriorRequest},
};

const HEADER: &str = "idempotency-key";
const MAX_KEY: usize = 255;

type Place = (Option<KeyId>, String);

/// The keys of requests that are being answered.
#[derive(Debug, Default)]
pub(super) struct InFlight(Mutex<BTreeSet<Place>>);

/// A request with a key, while it is being answered.
#[derive(Debug)]
pub(super) struct Keyed {
    in_flight: Arc<InFlight>,
    place: Place,
}

impl Drop for Keyed {
    fn drop(&mut self) {
        self.in_flight.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.place);
    }
}

/// Takes the request's key, if it has one, until the answer is dropped.
///
/// # Errors
/// 409 while another request with this key is being answered, 422 for a key that is none.
pub(super) fn begin(state: &AppState, caller: &Caller, headers: &HeaderMap) -> Result<Option<Keyed>, Fault> {
    let mut given = headers.get_all(HEADER).iter();
    let Some(value) = given.next() else { return Ok(None) };
    let key = value.to_str().ok().filter(|key| (1..=MAX_KEY).contains(&key.len()) && given.next().is_none());
    let key = key.ok_or_else(|| {
        Fault::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "invalid-idempotency-key",
            "Invalid Idempotency-Key",
            format!("Idempotency-Key: give one value of 1 to {MAX_KEY} printable ASCII characters"),
        )
    })?;
    let place = (caller.key, key.to_owned());
    let in_flight = state.in_flight();
    if !in_flight.0.lock().unwrap_or_else(PoisonError::into_inner).insert(place.clone()) {
        return Err(Fault::new(
            StatusCode::CONFLICT,
            "idempotency-in-flight",
            "Still being answered",
            "another request with this Idempotency-Key is still being answered; ask again once it has been",
        ));
    }
    Ok(Some(Keyed { in_flight: Arc::clone(in_flight), place }))
}

impl Keyed {
    /// What the store is to remember; `body` is the digest of the request's body.
    pub(super) fn intent(&self, method: &Method, uri: &Uri, body: Digest) -> IdempotentRequest {
        let mut hasher = Sha256::new();
        // None of the three can hold a line break.
        hasher.update(format!("{method}\n{}\n{}\n", uri.path(), uri.query().unwrap_or_default()));
        hasher.update(body.as_bytes());
        let fingerprint = Digest::from_bytes(hasher.finalize().into());
        let (owner, key) = self.place.clone();
        IdempotentRequest { owner, key, fingerprint }
    }
}

/// What a request like this one made before, if one did.
///
/// # Errors
/// 422 if the request that used the key asked for something else.
pub(super) async fn earlier(
    state: &AppState,
    intent: &IdempotentRequest,
) -> Result<Option<PriorRequest>, Fault> {
    let found = state.store().prior_request(intent.owner, &intent.key).await?;
    found.map(|found| same(intent, found)).transpose()
}

/// Holds what the store remembers against what is asked for now.
///
/// # Errors
/// 422 if they differ.
pub(super) fn same(intent: &IdempotentRequest, found: PriorRequest) -> Result<PriorRequest, Fault> {
    if found.fingerprint == intent.fingerprint {
        return Ok(found);
    }
    Err(Fault::new(
        StatusCode::UNPROCESSABLE_ENTITY,
        "idempotency-key-reused",
        "Idempotency-Key reused",
        format!("the Idempotency-Key '{}' was used for another request; use a fresh one", intent.key),
    ))
}

/// Marks an answer as that to an earlier request.
pub(super) fn mark_replayed(headers: &mut HeaderMap) {
    headers.insert("idempotency-replayed", HeaderValue::from_static("true"));
}
