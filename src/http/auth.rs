//! Who may pass: before any handler, a request is held to the table in [`super::scopes`].
//!
//! What always holds, and in each case of doubt the answer is no:
//!
//! - While the database has no key, everybody is let in as [`Caller::ANYBODY`]; only loopback is served then
//!   ([`super::HttpConfig::check_exposure`]). From the first key on, and for as long as the process lives, nothing under `/v1`
//!   answers without one, revoked keys and unknown paths included.
//! - While everybody is let in, the service answers to loopback names only ([`super::host`]), and with keys or without it refuses what pages
//!   of other sites make browsers send ([`cross_site`]).
//! - A browser shows a key as the password of HTTP Basic, and does so by itself also where another site's page sends it. So that is
//!   taken only for requests that change nothing.
//! - Only what passed here has a [`Caller`]; handlers that ask for one cannot run without.
//! - Behind this, no handler sees the key.

use std::sync::atomic::{AtomicBool, Ordering};

use axum::{
    extract::{MatchedPath, Request, State},
    http::{HeaderMap, HeaderValue, Method, StatusCode, header},
    middleware::Next,
    response::{IntoResponse as _, Response},
};
use base64::{Engine as _, engine::general_purpose::STANDARD};

use super::{
    client::{ClientAddress, TrustedProxies},
    cross_site::{self, Doing, FollowedLink},
    host::{Hosts, only},
    problem::Fault,
    scopes::{self, Access},
    state::AppState,
    throttle::Wait,
    unread::LetIn,
};
use crate::{
    domain::{ApiKey, Caller, Scope},
    store::KeyRecord,
};

/// Whether there were keys when last looked at; they never vanish.
#[derive(Debug, Default)]
pub(super) struct Lock(AtomicBool);

impl Lock {
    /// Looks whether there are keys, so that it is known from the first request on.
    pub(super) async fn prime(&self, state: &AppState) {
        if let Err(fault) = self.is_open(state).await {
            tracing::warn!("whether there are keys is not known yet: {fault:?}");
        }
    }

    /// Whether there were keys when last looked at.
    fn is_closed(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    async fn is_open(&self, state: &AppState) -> Result<bool, Fault> {
        if self.is_closed() {
            return Ok(false);
        }
        if state.limits().access.without_keys {
            return Ok(true);
        }
        let closed = state.store().has_keys().await?;
        self.0.store(closed, Ordering::Relaxed);
        Ok(!closed)
    }
}

/// Lets a request through to its handler, or answers it.
pub(super) async fn authenticate(
    State(state): State<AppState>,
    mut request: Request,
    next: Next,
) -> Response {
    let shown = take_key(request.headers_mut());
    let route = request.extensions().get::<MatchedPath>().map(|path| path.as_str().to_owned());
    let needed = match &route {
        Some(route) => scopes::access(request.method().as_str(), route),
        // Outside the API there is nothing to hide; within it, not even what there is not is told.
        None if !is_api(request.uri().path()) => Some(Access::Open),
        None => None,
    };
    let is_open_to_all = needed == Some(Access::Open);
    // What tells whether the process lives does not wait for the database.
    let open =
        if is_open_to_all { Ok(!state.lock().is_closed()) } else { state.lock().is_open(&state).await };
    if let Err(fault) = admit_page(&mut request, &open, &shown) {
        return fault.into_response();
    }
    if is_open_to_all {
        return next.run(request).await;
    }
    let stranger = Stranger::of(&request, &state.limits().access.trusted_proxies);
    let caller = match admit(&state, open, shown, needed, &stranger).await {
        Ok(caller) => caller,
        Err(fault) => return fault.into_response(),
    };
    if needed.is_some() {
        request.extensions_mut().insert(caller);
        let mut response = next.run(request).await;
        response.extensions_mut().insert(LetIn);
        return response;
    }
    let place = format!("{} {}", request.method(), route.as_deref().unwrap_or("unmatched"));
    let response = next.run(request).await;
    // The router knows no such operation either, or there is a row missing.
    if matches!(response.status(), StatusCode::NOT_FOUND | StatusCode::METHOD_NOT_ALLOWED) {
        return response;
    }
    Fault::internal(&std::io::Error::other(format!("{place} has no row in http/scopes.rs"))).into_response()
}

/// Refuses names that are not the service's and what pages of other sites make browsers send. In doubt whether keys are asked for,
/// none are.
fn admit_page(request: &mut Request, open: &Result<bool, Fault>, shown: &Shown) -> Result<(), Fault> {
    let hosts = Hosts::of(request)?;
    let asks_for_keys = matches!(open, Ok(false));
    if !asks_for_keys {
        hosts.expect_loopback()?;
    }
    if asks_for_keys && matches!(shown, Shown::Bearer(_)) {
        return Ok(());
    }
    if cross_site::judge(request.method(), request.headers(), &hosts)? == Doing::FollowedLink {
        request.extensions_mut().insert(FollowedLink);
    }
    Ok(())
}

/// Lets a request through to a listener that asks for no key; on a loopback address it answers to loopback names only.
pub(super) async fn admit_without_keys(
    State(on_loopback): State<bool>,
    request: Request,
    next: Next,
) -> Response {
    let admitted = Hosts::of(&request).and_then(|hosts| {
        if on_loopback {
            hosts.expect_loopback()?;
        }
        cross_site::judge(request.method(), request.headers(), &hosts)
    });
    match admitted {
        Ok(_) => next.run(request).await,
        Err(fault) => fault.into_response(),
    }
}

/// What is known of who sends a request before their key is looked at.
struct Stranger {
    address: Option<ClientAddress>,
    /// Whether the request changes nothing.
    reads: bool,
    /// Whether a browser is to show the answer as a page.
    wants_page: bool,
}

impl Stranger {
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

/// What a request shows for a key.
enum Shown {
    Nothing,
    Malformed,
    /// As a program shows it.
    Bearer(ApiKey),
    /// As a browser does.
    Basic(ApiKey),
}

/// Takes the `Authorization` header out of the request, so that nothing behind this can show it.
fn take_key(headers: &mut HeaderMap) -> Shown {
    let mut values = headers.get_all(header::AUTHORIZATION).iter();
    let shown = match (values.next(), values.next()) {
        (None, _) => Shown::Nothing,
        (Some(value), None) => credentials(value).unwrap_or(Shown::Malformed),
        (Some(_), Some(_)) => Shown::Malformed,
    };
    headers.remove(header::AUTHORIZATION);
    shown
}

fn credentials(value: &HeaderValue) -> Option<Shown> {
    let (scheme, given) = value.to_str().ok()?.split_once(' ')?;
    if scheme.eq_ignore_ascii_case("bearer") {
        given.trim().parse().ok().map(Shown::Bearer)
    } else if scheme.eq_ignore_ascii_case("basic") {
        password(given.trim()).map(Shown::Basic)
    } else {
        None
    }
}

/// The key in the credentials of HTTP Basic (RFC 7617): their password. The user's name, in whatever encoding, is passed over.
fn password(credentials: &str) -> Option<ApiKey> {
    let decoded = STANDARD.decode(credentials).ok()?;
    let colon = decoded.iter().position(|byte| *byte == b':')?;
    std::str::from_utf8(&decoded[colon + 1..]).ok()?.parse().ok()
}

async fn admit(
    state: &AppState,
    open: Result<bool, Fault>,
    shown: Shown,
    needed: Option<Access>,
    stranger: &Stranger,
) -> Result<Caller, Fault> {
    if open? {
        return Ok(Caller::ANYBODY);
    }
    let reads = stranger.reads;
    let fail = |fault: Fault| match state.throttle().failure(stranger.address) {
        Ok(()) => fault,
        Err(wait) => too_many_failures(reads, wait),
    };
    let key = match shown {
        Shown::Bearer(key) => key,
        Shown::Basic(key) if reads => key,
        Shown::Basic(_) => return Err(fail(not_by_basic())),
        // Browsers ask their users for a key only when they are answered 401.
        Shown::Nothing if reads && stranger.wants_page => return Err(no_key(reads)),
        Shown::Nothing => return Err(fail(no_key(reads))),
        Shown::Malformed => return Err(fail(bad_key(reads))),
    };
    // A good key passes however many bad ones came from its address: keys cannot be guessed, and behind a proxy all clients have
    // one address, so that one of them could lock out the rest.
    let record = state.store().authenticate(key.hash()).await?.ok_or_else(|| fail(bad_key(reads)))?;
    state.throttle().request(&record).map_err(|wait| too_many_requests(&record, wait))?;
    record_use(state, &record);
    if let Some(Access::Scope(scope)) = needed
        && !record.allows(scope)
    {
        return Err(out_of_scope(&record, scope));
    }
    Ok(Caller { key: Some(record.id), admin: record.is_admin() })
}

/// Writes down that the key is in use, beside the request: nobody need wait for it, and it is no loss if it fails.
fn record_use(state: &AppState, key: &KeyRecord) {
    if !state.throttle().is_due(key) {
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

fn no_key(reads: bool) -> Fault {
    let detail = if reads {
        "this service answers those who have a key: send 'Authorization: Bearer tcgs_...', or give a browser the key as password"
    } else {
        "this service answers those who have a key: send 'Authorization: Bearer tcgs_...'"
    };
    challenge(reads, Fault::new(StatusCode::UNAUTHORIZED, "no-key", "A key is needed", detail), BEARER)
}

fn bad_key(reads: bool) -> Fault {
    let detail = "the Authorization header holds no key that this service knows: it is mistyped, revoked or another service's";
    let fault = Fault::new(StatusCode::UNAUTHORIZED, "invalid-key", "The key is not valid", detail);
    challenge(reads, fault, BEARER_INVALID)
}

fn not_by_basic() -> Fault {
    let detail =
        "HTTP Basic is taken for GET and HEAD only; send the key as 'Authorization: Bearer tcgs_...'";
    let fault =
        Fault::new(StatusCode::UNAUTHORIZED, "bearer-needed", "The key is needed as a bearer's", detail);
    challenge(false, fault, BEARER)
}

const BEARER: &str = "Bearer realm=\"tcgs\"";
const BEARER_INVALID: &str = "Bearer realm=\"tcgs\", error=\"invalid_token\"";
const BASIC: &str = "Basic realm=\"tcgs\"";

/// Says by which schemes a key is taken. A browser asks its user for one where it may be sent by its own.
fn challenge(reads: bool, fault: Fault, bearer: &'static str) -> Fault {
    let fault = fault.with(header::WWW_AUTHENTICATE, HeaderValue::from_static(bearer));
    if reads { fault.with(header::WWW_AUTHENTICATE, HeaderValue::from_static(BASIC)) } else { fault }
}

fn out_of_scope(key: &KeyRecord, scope: Scope) -> Fault {
    let has: Vec<&str> = key.scopes.iter().map(|scope| scope.name()).collect();
    let detail =
        format!("this needs the scope {}; the key '{}' has {}", scope.name(), key.name, has.join(", "));
    let challenge = match scope {
        Scope::Read => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"read\"",
        Scope::ScenesWrite => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"scenes:write\"",
        Scope::JobsWrite => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"jobs:write\"",
        Scope::Admin => "Bearer realm=\"tcgs\", error=\"insufficient_scope\", scope=\"admin\"",
    };
    Fault::new(StatusCode::FORBIDDEN, "insufficient-scope", "The key does not allow this", detail)
        .with(header::WWW_AUTHENTICATE, HeaderValue::from_static(challenge))
}

fn too_many_requests(key: &KeyRecord, wait: Wait) -> Fault {
    let detail = format!(
        "the key '{}' has sent more requests than its rate allows; the next one is taken in {} s",
        key.name,
        wait.seconds()
    );
    Fault::new(StatusCode::TOO_MANY_REQUESTS, "too-many-requests", "Too many requests", detail)
        .with(header::RETRY_AFTER, wait.seconds().into())
}

fn too_many_failures(reads: bool, wait: Wait) -> Fault {
    let detail =
        "too many requests without a valid key came from this address; send one with a valid key, or wait";
    let fault = Fault::new(
        StatusCode::TOO_MANY_REQUESTS,
        "too-many-failures",
        "Too many requests without a key",
        detail,
    );
    challenge(reads, fault.with(header::RETRY_AFTER, wait.seconds().into()), BEARER)
}
