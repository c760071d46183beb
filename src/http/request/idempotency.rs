//! `Idempotency-Key`: a request that is sent again creates nothing again.
//!
//! The store remembers what a key created, in the transaction that created it ([`crate::store::IdempotentRequest`]). Which requests are
//! in flight is known to this process alone and ends with it, so a request cut off by a crash can simply be sent again. Between
//! processes the store decides: of two requests with one key, one creates the resource and the other gets it.

use std::future::Future;

use axum::http::{HeaderMap, HeaderValue, Uri};
use sha2::{Digest as _, Sha256};

use crate::{
    domain::{Caller, Digest, ProblemType},
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        shared::IdempotencyGuard,
        state::AppState,
    },
    store::{IdempotentRequest, PriorRequest, StoreError},
};

const HEADER: &str = "idempotency-key";
const MAX_KEY: usize = 255;

/// A `POST` that creates something, without its body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CreateRequest<'a> {
    pub(crate) state: &'a AppState,
    pub(crate) caller: Caller,
    pub(crate) uri: &'a Uri,
    pub(crate) headers: &'a HeaderMap,
}

/// What a `POST` that creates something returns.
#[derive(Debug)]
pub(crate) enum CreateOutcome<T> {
    Created(T),
    /// An earlier request with the same `Idempotency-Key` created this.
    Replayed(T),
}

/// Something that requests with an `Idempotency-Key` create.
pub(crate) trait Resource: Sized {
    /// Reads what an earlier request of the caller's project created, which an administrator may have created for another project.
    ///
    /// # Errors
    /// 404 if it has been deleted since, or is not for the caller to see.
    fn load(
        state: &AppState,
        caller: Caller,
        remembered: &PriorRequest,
    ) -> impl Future<Output = ApiResult<Self>> + Send;
}

impl CreateRequest<'_> {
    /// Puts the request's key in flight, if it has one.
    ///
    /// # Errors
    /// 409 while another request with this key is in flight, 422 for an invalid key.
    pub(crate) fn begin(&self) -> ApiResult<Option<IdempotencyGuard>> {
        let mut given = self.headers.get_all(HEADER).iter();
        let Some(value) = given.next() else { return Ok(None) };
        let is_valid = |key: &&str| (1..=MAX_KEY).contains(&key.len()) && given.next().is_none();
        let Some(key) = value.to_str().ok().filter(is_valid) else {
            return Err(ProblemType::InvalidIdempotencyKey.because(format!(
                "Idempotency-Key: give one value of 1 to {MAX_KEY} printable ASCII characters"
            )));
        };
        let guard = self.state.in_flight.begin((self.caller.project, key.to_owned()));
        let in_flight = || {
            ProblemType::IdempotencyInFlight.because(
                "another request with this Idempotency-Key is still being answered; ask again once it has been",
            )
        };
        guard.ok_or_else(in_flight).map(Some)
    }

    /// What the store remembers of a request whose body has this digest.
    pub(crate) fn intent(&self, guard: Option<&IdempotencyGuard>, body: Digest) -> Option<IdempotentRequest> {
        let (project, key) = guard?.key().clone();
        let mut hasher = Sha256::new();
        // Neither can hold a line break.
        hasher.update(format!("POST\n{}\n{}\n", self.uri.path(), self.uri.query().unwrap_or_default()));
        hasher.update(body.as_bytes());
        Some(IdempotentRequest { project, key, fingerprint: Digest::from_bytes(hasher.finalize().into()) })
    }
}

/// Creates a resource, unless an earlier request with the same intent has.
///
/// # Errors
/// 422 if the earlier request with this key was another one; whatever `create` and [`Resource::load`] return.
pub(crate) async fn idempotent<T: Resource>(
    request: CreateRequest<'_>,
    intent: Option<IdempotentRequest>,
    create: impl Future<Output = ApiResult<Result<T, StoreError>>>,
) -> ApiResult<CreateOutcome<T>> {
    let CreateRequest { state, caller, .. } = request;
    let Some(intent) = intent else { return Ok(CreateOutcome::Created(create.await??)) };
    let earlier = match state.store().prior_request(intent.project, &intent.key).await? {
        Some(earlier) => earlier,
        None => match create.await? {
            // Another process was faster.
            Err(StoreError::IdempotencyKeyUsed(earlier)) => *earlier,
            created => return Ok(CreateOutcome::Created(created?)),
        },
    };
    if earlier.fingerprint != intent.fingerprint {
        return Err(ProblemType::IdempotencyKeyReused.because(format!(
            "the Idempotency-Key '{}' was used for another request; use a fresh one",
            intent.key
        )));
    }
    Ok(CreateOutcome::Replayed(T::load(state, caller, &earlier).await?))
}

/// 404 for a resource that an earlier request created, and that the caller cannot see.
pub(crate) fn not_replayable(kind: ProblemType, what: &str, remembered: &PriorRequest) -> ProblemResponse {
    kind.because(format!(
        "an earlier request with this Idempotency-Key created {what} {}, which has been deleted or is another \
         project's; use a fresh key for another",
        remembered.resource
    ))
}

/// Marks a response as the replay of an earlier one.
pub(crate) fn mark_replayed(headers: &mut HeaderMap) {
    headers.insert("idempotency-replayed", HeaderValue::from_static("true"));
}
