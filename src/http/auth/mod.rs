//! Authentication and authorisation: middleware that checks a request against the table in [`self::scopes`] before any handler.
//!
//! Invariants; in case of doubt a request is refused:
//!
//! - While the database has no key, every caller is [`Caller::ANONYMOUS`], and only loopback is served
//!   ([`super::HttpConfig::check_exposure`]). From the first key on, until the process ends, nothing under `/v1` is answered without
//!   one; that includes revoked and expired keys and unknown paths.
//! - Without keys only loopback host names are accepted ([`self::host`]); with or without keys, requests forged by other sites' pages
//!   are refused ([`cross_site`]), unless the operator allows their origin ([`super::origins`]).
//! - Browsers send a key as the password of HTTP Basic, also with requests caused by other sites' pages. So Basic is accepted only for
//!   requests that change nothing.
//! - A session's cookie comes with requests of this service's pages alone (`SameSite=Strict`). One that could change something must also
//!   say so itself (`Sec-Fetch-Site: same-origin`), which no page can forge.
//! - A shared link opens reads of one job ([`shared_link`]), without a key and whatever keys there are.
//! - Handlers that extract a [`Caller`] run only after this middleware.
//! - No handler sees the key, and none but those of sessions their hash.

pub(super) mod caller;
mod credentials;
pub(super) mod cross_site;
mod host;
mod refusals;
pub(super) mod revocation;
mod scopes;
mod session_cookie;
pub(super) mod shared_link;

use axum::{
    extract::{MatchedPath, Request, State},
    http::{Method, StatusCode, header},
    middleware::Next,
    response::{IntoResponse as _, Response},
};

use self::{
    credentials::{Credentials, take_credentials},
    cross_site::{FollowedLink, RequestOrigin},
    host::{Hosts, only},
    refusals::{
        bad_key, no_key, not_by_basic, out_of_scope, session_ended, too_many_failures, too_many_requests,
    },
    scopes::Access,
    shared_link::{LinkRequest, PathToken},
};
pub(super) use self::{
    refusals::bearer_needed,
    session_cookie::{ActiveSession, SESSION_COOKIE},
};
use super::{
    client_address::{ClientAddress, TrustedProxies},
    origins::AllowedOrigins,
    problem::{Answer as _, ApiResult, ProblemResponse},
    state::AppState,
};
use crate::{
    domain::{Caller, ProblemType, SessionToken},
    store::KeyRecord,
};

/// Marks the response to a request that passed [`authenticate`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Authenticated;

/// Passes a request to its handler, or refuses it.
pub(super) async fn authenticate(
    State(state): State<AppState>,
    mut request: Request,
    next: Next,
) -> Response {
    let mut credentials = take_credentials(request.headers_mut());
    let route = request.extensions().get::<MatchedPath>().map(|path| path.as_str().to_owned());
    let needed = match &route {
        Some(route) => scopes::access(request.method().as_str(), route),
        // Under /v1, unknown paths need a key too, so that nothing is disclosed.
        None if !is_api(request.uri().path()) => Some(Access::Open),
        None => None,
    };
    let is_open_to_all = needed == Some(Access::Open);
    // Open operations, such as /healthz, do not wait for the database.
    let open = if is_open_to_all {
        Ok(!state.auth_mode.requires_keys())
    } else {
        state.auth_mode.allows_anonymous().await
    };
    let origins = &state.limits.access.allowed_origins;
    if let Err(error) = admit_page(&mut request, &open, &credentials, origins) {
        return error.into_response();
    }
    if let Some(token) = request.extensions_mut().remove::<PathToken>() {
        return by_link(&state, token, request, route, next).await;
    }
    if is_open_to_all {
        return next.run(request).await;
    }
    let client = ClientInfo::of(&request, &state.limits.access.trusted_proxies);
    if let (Ok(false), Credentials::Session(token)) = (&open, &credentials) {
        credentials = match signed_in(&state, token, &client).await {
            Ok(credentials) => credentials,
            Err(error) => return error.into_response(),
        };
    }
    let session = match &credentials {
        Credentials::SignedIn(hash, _) => Some(*hash),
        _ => None,
    };
    request.extensions_mut().insert(ActiveSession(session));
    if matches!(needed, Some(Access::Optional(_)))
        && matches!(open, Ok(false))
        && matches!(credentials, Credentials::Nothing | Credentials::EndedSession)
    {
        return next.run(request).await;
    }
    let caller = match admit(&state, open, credentials, needed, &client).await {
        Ok(caller) => caller,
        Err(error) => return error.into_response(),
    };
    if needed.is_some() {
        request.extensions_mut().insert(caller);
        let mut response = next.run(request).await;
        response.extensions_mut().insert(Authenticated);
        return response;
    }
    let place = format!("{} {}", request.method(), route.as_deref().unwrap_or("unmatched"));
    let response = next.run(request).await;
    // Either the router has no such operation, or a row is missing.
    if matches!(response.status(), StatusCode::NOT_FOUND | StatusCode::METHOD_NOT_ALLOWED) {
        return response;
    }
    ProblemResponse::internal(&std::io::Error::other(format!("{place} has no row in http/auth/scopes.rs")))
        .into_response()
}

/// Passes a request by a shared link to its handler, if the link opens that. Links that open nothing count as keys that are none do.
async fn by_link(
    state: &AppState,
    token: PathToken,
    mut request: Request,
    route: Option<String>,
    next: Next,
) -> Response {
    let client = ClientInfo::of(&request, &state.limits.access.trusted_proxies);
    let (caller, link) = match shared_link::admit(state, token, LinkRequest::of(&request, route)).await {
        Ok(admitted) => admitted,
        Err(error) => {
            let over = state.throttle.failure(client.address).err();
            return over.map_or(error, |wait| too_many_failures(client.reads, wait)).into_response();
        }
    };
    request.extensions_mut().insert(caller);
    request.extensions_mut().insert(link);
    next.run(request).await
}

/// Refuses foreign host names and forged requests. If it is unknown whether keys are required, they count as not required.
fn admit_page(
    request: &mut Request,
    open: &ApiResult<bool>,
    credentials: &Credentials,
    origins: &AllowedOrigins,
) -> ApiResult<()> {
    let hosts = Hosts::of(request)?;
    let asks_for_keys = matches!(open, Ok(false));
    if !asks_for_keys {
        hosts.expect_loopback()?;
    }
    if asks_for_keys && matches!(credentials, Credentials::Bearer(_)) {
        return Ok(());
    }
    let origin = cross_site::classify(request.method(), request.headers(), &hosts, origins)?;
    if origin == RequestOrigin::FollowedLink {
        request.extensions_mut().insert(FollowedLink);
    }
    Ok(())
}

/// Middleware of a listener without keys; on a loopback address it accepts loopback host names only.
pub(super) async fn admit_without_keys(
    State(on_loopback): State<bool>,
    request: Request,
    next: Next,
) -> Response {
    let admitted = Hosts::of(&request).and_then(|hosts| {
        if on_loopback {
            hosts.expect_loopback()?;
        }
        cross_site::classify(request.method(), request.headers(), &hosts, &AllowedOrigins::default())
    });
    match admitted {
        Ok(_) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

/// What is known about a client before its key is checked.
struct ClientInfo {
    address: Option<ClientAddress>,
    /// Whether the request changes nothing.
    reads: bool,
    /// Whether a browser will show the response as a page.
    wants_page: bool,
    /// Whether a browser says that a page of this service made the request.
    is_same_origin: bool,
}

impl ClientInfo {
    fn of(request: &Request, proxies: &TrustedProxies) -> Self {
        let headers = request.headers();
        let peer = request.extensions().get::<ClientAddress>().copied();
        let wants_page = match only(headers, "sec-fetch-mode") {
            Some(mode) => mode == "navigate",
            None => headers
                .get(header::ACCEPT)
                .is_some_and(|accept| accept.to_str().is_ok_and(|text| text.contains("text/html"))),
        };
        Self {
            address: peer.map(|peer| peer.behind(proxies, headers)),
            reads: is_read(request.method()),
            wants_page,
            is_same_origin: only(headers, "sec-fetch-site") == Some("same-origin"),
        }
    }
}

fn is_api(path: &str) -> bool {
    path == "/v1" || path.starts_with("/v1/")
}

/// Whether a request with this method changes nothing.
fn is_read(method: &Method) -> bool {
    matches!(*method, Method::GET | Method::HEAD)
}

/// What a session's cookie stands for.
///
/// # Errors
/// 403 for a request that may change something and does not come from a page of this service.
async fn signed_in(state: &AppState, token: &SessionToken, client: &ClientInfo) -> ApiResult<Credentials> {
    let found = state.store().session_key(token.hash()).await?;
    let Some(record) = found else { return Ok(Credentials::EndedSession) };
    if !client.reads && !client.is_same_origin {
        let detail = "a session changes something only for pages of this service, whose browser sends Sec-Fetch-Site: same-origin; \
                      programs send a key";
        return Err(ProblemType::CrossSiteRequest.because(detail));
    }
    Ok(Credentials::SignedIn(token.hash(), Box::new(record)))
}

async fn admit(
    state: &AppState,
    open: ApiResult<bool>,
    credentials: Credentials,
    needed: Option<Access>,
    client: &ClientInfo,
) -> ApiResult<Caller> {
    if open? {
        return Ok(Caller::ANONYMOUS);
    }
    let reads = client.reads;
    let fail = |error: ProblemResponse| match state.throttle.failure(client.address) {
        Ok(()) => error,
        Err(wait) => too_many_failures(reads, wait),
    };
    let record = match credentials {
        Credentials::SignedIn(_, record) => *record,
        Credentials::Session(_) | Credentials::EndedSession if !client.wants_page => {
            return Err(fail(session_ended()));
        }
        credentials => key_of(state, credentials, client, &fail).await?,
    };
    state.throttle.request(&record).map_err(|wait| too_many_requests(&record, wait))?;
    record_use(state, &record);
    if let Some(scope) = needed.and_then(Access::scope)
        && !record.allows(scope)
    {
        return Err(out_of_scope(&record, scope));
    }
    Ok(Caller { key: Some(record.id), link: None, project: record.project_id, admin: record.is_admin() })
}

/// The key that a request shows.
async fn key_of(
    state: &AppState,
    credentials: Credentials,
    client: &ClientInfo,
    fail: &(dyn Fn(ProblemResponse) -> ProblemResponse + Sync),
) -> ApiResult<KeyRecord> {
    let reads = client.reads;
    let key = match credentials {
        Credentials::Bearer(key) => key,
        Credentials::Basic(key) if reads => key,
        Credentials::Basic(_) => return Err(fail(not_by_basic())),
        // Browsers ask their users for a key only after a 401.
        Credentials::Malformed => return Err(fail(bad_key(reads))),
        _ if reads && client.wants_page => return Err(no_key(reads)),
        _ => return Err(fail(no_key(reads))),
    };
    // A valid key passes however many invalid ones came from its address: keys cannot be guessed, and behind a proxy all clients share
    // an address, so one of them could lock out the rest.
    state.store().authenticate(key.hash()).await?.ok_or_else(|| fail(bad_key(reads)))
}

/// Records the use of a key in the background; a failure is harmless.
fn record_use(state: &AppState, key: &KeyRecord) {
    if !state.throttle.is_due(key) {
        return;
    }
    let (state, id) = (state.clone(), key.id);
    tokio::spawn(async move {
        if let Err(error) = state.store().touch_key(id).await {
            tracing::debug!(
                error = &error as &dyn std::error::Error,
                "the use of key {id} was not recorded: {error}"
            );
        }
    });
}
