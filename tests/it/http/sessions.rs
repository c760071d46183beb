//! Sessions of browsers: how they begin, what they may do, and how they end.

use jiff::SignedDuration;
use tcgs::domain::Scope;

use super::access::{stopped_clock, with_key};
use crate::support::{
    contract::Coverage,
    server::{Answer, Server, Setup, TestKey},
};

/// Signs in and returns the cookie as a browser sends it.
async fn sign_in(server: &Server, key: &TestKey) -> String {
    let answer = with_key(server, "POST", "/session", &key.key).await.expect(204);
    let cookie = answer.header("set-cookie");
    cookie.split(';').next().expect("a pair").to_owned()
}

async fn with_cookie(server: &Server, method: &str, path: &str, cookie: &str, site: Option<&str>) -> Answer {
    server
        .send(method, path, |request| {
            let request = request.header("cookie", cookie);
            site.into_iter().fold(request, |request, site| request.header("sec-fetch-site", site))
        })
        .await
}

pub(super) async fn a_browser_signs_in_by_its_key_and_changes_things_from_its_own_pages_only(
    coverage: Coverage,
) {
    let (setup, _) = stopped_clock();
    let server = Server::start_with(&coverage, setup).await;
    server.post("/session").await.expect_problem(409, "no-keys-yet");
    server.send("DELETE", "/session", |request| request).await.expect(204);
    // Cookies of whatever was here before mean nothing to a service without keys.
    with_cookie(&server, "GET", "/v1/jobs", &format!("tcgs_session={}", "0a".repeat(32)), None)
        .await
        .expect(200);

    let [mine, other] = [
        server.key(&[Scope::Read, Scope::JobsWrite]).await,
        server.key(&[Scope::Read, Scope::JobsWrite]).await,
    ];
    let plain = with_key(&server, "POST", "/session", &mine.key).await.expect(204);
    let attributes = |answer: &Answer| {
        let cookie = answer.header("set-cookie").to_owned();
        cookie.split("; ").skip(1).map(str::to_owned).collect::<Vec<_>>().join("; ")
    };
    assert_eq!(
        attributes(&plain),
        "Max-Age=2592000; HttpOnly; SameSite=Strict",
        "the folder of /session is its path"
    );
    let over_tls = server.send("POST", "/session", |request| {
        request.bearer_auth(&mine.key).header("origin", "https://scenes.example")
    });
    assert!(attributes(&over_tls.await.expect(204)).ends_with("; Secure"));
    server.post("/session?life=9").await.expect_problem(401, "no-key");
    with_key(&server, "POST", "/session?life=9", &mine.key).await.expect_problem(422, "invalid-parameter");
    with_key(&server, "DELETE", "/session?life=9", &mine.key).await.expect_problem(422, "invalid-parameter");

    let cookie = sign_in(&server, &mine).await;
    let create = async |site: Option<&str>| {
        server
            .send("POST", "/v1/jobs", |request| {
                let request = request.header("cookie", &cookie).header("content-type", "application/zip");
                site.into_iter()
                    .fold(request, |request, site| request.header("sec-fetch-site", site))
                    .body("succeed")
            })
            .await
    };
    for site in [None, Some("same-site"), Some("cross-site"), Some("none")] {
        create(site).await.expect_problem(403, "cross-site-request");
    }
    let job = create(Some("same-origin")).await.expect(201).header("location").to_owned();
    with_cookie(&server, "GET", &job, &cookie, None).await.expect(200);
    let narrow = with_cookie(&server, "DELETE", "/v1/datasets/17", &cookie, Some("same-origin")).await;
    narrow.expect_problem(403, "insufficient-scope");
    with_cookie(&server, "POST", "/session", &cookie, Some("same-origin"))
        .await
        .expect_problem(401, "bearer-needed");
    let foreign = sign_in(&server, &other).await;
    with_cookie(&server, "GET", &job, &foreign, None).await.expect_problem(404, "job-not-found");
    // A key that is shown counts more than a cookie.
    let both = server.send("GET", &job, |request| request.header("cookie", &foreign).bearer_auth(&mine.key));
    both.await.expect(200);

    // The database has no token by which anybody could come in.
    let token = cookie.split_once('=').expect("a pair").1.to_owned();
    for suffix in ["", "-wal"] {
        let file = std::fs::read(format!("{}{suffix}", server.database().display())).unwrap_or_default();
        assert!(!file.windows(token.len()).any(|window| window == token.as_bytes()), "the token is stored");
    }
}

pub(super) async fn a_session_ends_with_its_key_its_age_or_by_signing_out(coverage: Coverage) {
    let (setup, clock) = stopped_clock();
    let server = Server::start_with(&coverage, Setup { worker: false, ..setup }).await;
    let key = server.key(&[Scope::Read]).await;
    let asks_for_a_key = async |cookie: &str| {
        let page =
            server.send("GET", "/", |request| request.header("accept", "text/html").header("cookie", cookie));
        let page = String::from_utf8(page.await.expect(200).body.to_vec()).expect("UTF-8");
        (page.contains("id=\"sign-in\""), page.contains("id=\"sign-out\""))
    };
    let is_over = async |cookie: &str| {
        let answer = with_cookie(&server, "GET", "/v1/jobs", cookie, Some("same-origin")).await;
        // A browser would ask its user for a password, in the middle of a page.
        let challenges = answer.headers.get_all("www-authenticate").into_iter().count();
        assert_eq!((answer.status, challenges), (401, 1), "{answer:?}");
        answer.expect_problem(401, "no-key");
        assert_eq!(asks_for_a_key(cookie).await, (true, false));
    };
    let [first, second, third] =
        [sign_in(&server, &key).await, sign_in(&server, &key).await, sign_in(&server, &key).await];
    assert_eq!(asks_for_a_key(&first).await, (false, true));

    with_cookie(&server, "DELETE", "/session", &first, None).await.expect_problem(403, "cross-site-request");
    let out = with_cookie(&server, "DELETE", "/session", &first, Some("same-origin")).await.expect(204);
    assert!(out.header("set-cookie").starts_with("tcgs_session=; Max-Age=0;"));
    is_over(&first).await;
    with_cookie(&server, "GET", "/v1/jobs", &second, None).await.expect(200);

    clock.advance(SignedDuration::from_hours(30 * 24 - 1));
    let fourth = sign_in(&server, &key).await;
    with_cookie(&server, "GET", "/v1/jobs", &second, None).await.expect(200);
    clock.advance(SignedDuration::from_hours(1));
    is_over(&second).await;
    is_over(&third).await;
    with_cookie(&server, "GET", "/v1/jobs", &fourth, None).await.expect(200);

    server.revoke(&key).await;
    is_over(&fourth).await;

    // A key's newest hundred are enough.
    let key = server.key(&[Scope::Read]).await;
    let oldest = sign_in(&server, &key).await;
    clock.advance(SignedDuration::from_secs(1));
    for _ in 0..99 {
        sign_in(&server, &key).await;
    }
    with_cookie(&server, "GET", "/v1/jobs", &oldest, None).await.expect(200);
    sign_in(&server, &key).await;
    is_over(&oldest).await;
}
