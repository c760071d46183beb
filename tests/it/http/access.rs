//! Keys: who is let in, to what, and how often.

use std::{num::NonZeroU32, sync::Arc};

use jiff::SignedDuration;
use tcgs::{
    domain::{KeyLimits, ManualClock, Scope},
    http::config::{AccessRules, RequestLimits},
};

use crate::support::{
    contract::{self, Coverage},
    server::{Answer, Server, Setup},
};

/// A key of the right form that no service knows.
const UNKNOWN: &str = "tcgs_000102030405060708090a0b0c0d0e0f10111213b57d5e69";

/// A service whose time stands still, so that no bucket fills while a test takes its time.
fn stopped_clock() -> (Setup, Arc<ManualClock>) {
    let clock = Arc::new(ManualClock::new("2026-11-21T12:00:00Z".parse().expect("an instant")));
    let access = AccessRules { failures_per_minute: NonZeroU32::MAX, ..AccessRules::default() };
    let limits = RequestLimits { access, ..RequestLimits::default() };
    (Setup { clock: clock.clone(), worker: false, limits, ..Setup::default() }, clock)
}

async fn with_key(server: &Server, method: &str, path: &str, key: &str) -> Answer {
    server.send(method, path, |request| request.bearer_auth(key)).await
}

pub(super) async fn no_operation_answers_without_the_right_key(coverage: Coverage) {
    let server = Server::start_with(&coverage, stopped_clock().0).await;
    for operation in contract::guarded() {
        let answer = server.send(operation.method, &operation.path(), |request| request).await;
        assert_ne!(
            answer.status, 401,
            "{}: without any key in the database, everybody is let in",
            operation.id
        );
    }

    let revoked = server.key(&Scope::ALL).await;
    server.revoke(&revoked).await;
    let one_a_minute = KeyLimits { requests_per_minute: NonZeroU32::new(1), ..KeyLimits::default() };
    let spent = server.key_with(&Scope::ALL, one_a_minute).await;
    with_key(&server, "GET", "/v1/jobs", &spent.key).await.expect(200);

    for operation in contract::guarded() {
        let (method, path, id) = (operation.method, operation.path(), &operation.id);
        let refused = |answer: Answer, status: u16, kind: &str| {
            assert_eq!(answer.status, status, "{id}: {}", String::from_utf8_lossy(&answer.body));
            let challenge =
                answer.headers.get("www-authenticate").map(|value| value.to_str().expect("ASCII"));
            assert!(
                challenge.is_none_or(|challenge| challenge.starts_with("Bearer ")),
                "{id}: {challenge:?}"
            );
            if method != "HEAD" {
                answer.expect_problem(status, kind);
            }
        };
        refused(server.send(method, &path, |request| request).await, 401, "no-key");
        for bad in [UNKNOWN, &revoked.key, "tcgs_17", "", &revoked.key[5..]] {
            refused(with_key(&server, method, &path, bad).await, 401, "invalid-key");
        }
        for header in [format!("Basic {}", spent.key), spent.key.clone(), "Bearer".to_owned()] {
            let answer = server.send(method, &path, |request| request.header("authorization", header)).await;
            refused(answer, 401, "invalid-key");
        }
        for scope in Scope::ALL.into_iter().filter(|scope| *scope != Scope::Admin) {
            let key = server.key(&[scope]).await;
            let answer = with_key(&server, method, &path, &key.key).await;
            if scope == operation.scope {
                assert!(!matches!(answer.status, 401 | 403), "{id} needs {}: {answer:?}", scope.name());
            } else {
                refused(answer, 403, "insufficient-scope");
            }
        }
        let admin = server.key(&[Scope::Admin]).await;
        let answer = with_key(&server, method, &path, &admin.key).await;
        assert!(!matches!(answer.status, 401 | 403), "{id}: an administrator may do everything: {answer:?}");
        refused(with_key(&server, method, &path, &spent.key).await, 429, "too-many-requests");
    }

    for path in ["/v1", "/v1/", "/v1/nothing", "/v1/jobs/a/b/c"] {
        server.get(path).await.expect_problem(401, "no-key");
        with_key(&server, "GET", path, UNKNOWN).await.expect_problem(401, "invalid-key");
    }
    server.send("DELETE", "/v1/jobs", |request| request).await.expect_problem(401, "no-key");
    let reader = server.key(&[Scope::Read]).await;
    with_key(&server, "GET", "/v1/nothing", &reader.key).await.expect_problem(404, "not-found");
    with_key(&server, "DELETE", "/v1/jobs", &reader.key).await.expect_problem(405, "method-not-allowed");
    for path in ["/healthz", "/readyz", "/version", "/openapi.yaml"] {
        server.get(path).await.expect(200);
        with_key(&server, "GET", path, "nonsense").await.expect(200);
    }
    server.get("/elsewhere").await.expect_problem(404, "not-found");
}

pub(super) async fn the_first_key_closes_the_service_and_revoking_the_last_does_not_open_it(
    coverage: Coverage,
) {
    let server = Server::start(&coverage).await;
    server.get("/v1/jobs").await.expect(200);
    let key = server.key(&[Scope::Read]).await;
    server.get("/v1/jobs").await.expect_problem(401, "no-key");
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    let lower =
        |request: reqwest::RequestBuilder| request.header("authorization", format!("bearer {}", key.key));
    server.send("GET", "/v1/jobs", lower).await.expect(200);
    let twice = |request: reqwest::RequestBuilder| request.bearer_auth(&key.key).bearer_auth(&key.key);
    server.send("GET", "/v1/jobs", twice).await.expect_problem(401, "invalid-key");
    server.revoke(&key).await;
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect_problem(401, "invalid-key");
    server.get("/v1/jobs").await.expect_problem(401, "no-key");
}

pub(super) async fn a_key_has_its_rate_and_an_address_a_few_failures(coverage: Coverage) {
    let (mut setup, clock) = stopped_clock();
    setup.limits.access.failures_per_minute = NonZeroU32::new(3).expect("three");
    let server = Server::start_with(&coverage, setup).await;
    let limits = KeyLimits { requests_per_minute: NonZeroU32::new(4), ..KeyLimits::default() };
    let key = server.key_with(&[Scope::Read], limits).await;
    for _ in 0..4 {
        with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    }
    let answer = with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(429);
    assert_eq!(answer.header("retry-after"), "15");
    with_key(&server, "GET", "/healthz", &key.key).await.expect(200);
    clock.advance(SignedDuration::from_secs(15));
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(200);
    with_key(&server, "GET", "/v1/jobs", &key.key).await.expect(429);

    for _ in 0..3 {
        with_key(&server, "GET", "/v1/jobs", UNKNOWN).await.expect_problem(401, "invalid-key");
    }
    let answer = server.get("/v1/jobs").await.expect(429);
    assert_eq!(answer.header("retry-after"), "20");
    answer.expect_problem(429, "too-many-failures");
    let other = server.key(&[Scope::Read]).await;
    with_key(&server, "GET", "/v1/jobs", &other.key).await.expect(200);
    clock.advance(SignedDuration::from_secs(20));
    server.get("/v1/jobs").await.expect_problem(401, "no-key");
}
