//! Datasets in forms and as bytes of no particular type, and the datasets of jobs.

use serde_json::{Value, json};
use tcgs::{
    domain::{ProjectLimits, Scope},
    http::config::RequestLimits,
};

use crate::support::{
    contract::Coverage,
    server::{Answer, Server, Setup},
};

const BOUNDARY: &str = "between-the-parts";

fn idle() -> Setup {
    Setup { worker: false, ..Setup::default() }
}

/// A form as browsers send it; `file` has a file name.
fn form(fields: &[(&str, &str)]) -> Vec<u8> {
    let mut body = String::new();
    for (name, value) in fields {
        let file =
            if *name == "file" { "; filename=\"scene.zip\"\r\nContent-Type: application/zip" } else { "" };
        body += &format!(
            "--{BOUNDARY}\r\nContent-Disposition: form-data; name=\"{name}\"{file}\r\n\r\n{value}\r\n"
        );
    }
    (body + &format!("--{BOUNDARY}--\r\n")).into_bytes()
}

async fn send(server: &Server, path: &str, body: Vec<u8>) -> Answer {
    send_as(server, path, body, |request| request).await
}

async fn send_as(
    server: &Server,
    path: &str,
    body: Vec<u8>,
    fill: impl FnOnce(reqwest::RequestBuilder) -> reqwest::RequestBuilder,
) -> Answer {
    let media_type = format!("multipart/form-data; boundary={BOUNDARY}");
    server.send("POST", path, |request| fill(request.header("content-type", media_type).body(body))).await
}

pub(super) async fn a_dataset_comes_in_a_form_or_as_bytes(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let by_body =
        server.upload("?seed=7&name=garden&metadata[site]=north", "succeed").await.expect(201).json();
    let fields = [("seed", "7"), ("name", "garden"), ("lambda", ""), ("metadata[site]", "north")];
    let file = [("file", "succeed")];
    for (query, parts) in [
        ("", [&fields[..], &file].concat()),
        ("", [&file[..], &fields].concat()),
        ("?seed=7", [&file[..], &fields[1..]].concat()),
    ] {
        let made = send(&server, &format!("/v1/jobs{query}"), form(&parts)).await.expect(201).json();
        for same in ["options", "name", "metadata", "dataset", "dataset_id"] {
            assert_eq!(made[same], by_body[same], "{same}");
        }
    }
    for path in ["/v1/jobs", "/v1/datasets", "/v1/scenes"] {
        let bytes = server.send("POST", path, |request| {
            request.header("content-type", "application/octet-stream").body("succeed")
        });
        let status = bytes.await.status;
        assert!(matches!(status, 200 | 201), "{path}: {status}");
    }
    let named = form(&[("name", "statue"), ("skip_missing", "false"), ("file", "succeed twice")]);
    let made = send(&server, "/v1/datasets", named.clone()).await.expect(201).json();
    assert_eq!((&made["name"], &made["kept"]), (&json!("statue"), &json!(true)));
    assert_eq!(send(&server, "/v1/scenes", named).await.expect(200).json()["id"], made["id"]);
    // Longer than any piece that arrives at once, with what looks like a boundary.
    let long = format!("succeed {}", format!("\r\n--{}", &BOUNDARY[..BOUNDARY.len() - 1]).repeat(9_000));
    let by_form = send(&server, "/v1/datasets", form(&[("file", &long)])).await.expect(201).json();
    let by_body = server.send("POST", "/v1/datasets", |request| {
        request.header("content-type", "application/octet-stream").body(long.clone())
    });
    assert_eq!(by_body.await.expect(200).json()["id"], by_form["id"], "the same bytes");
}

pub(super) async fn what_is_wrong_with_a_form_is_said(coverage: Coverage) {
    let server = Server::start_with(&coverage, idle()).await;
    let whole = form(&[("file", "succeed")]);
    for path in ["/v1/jobs", "/v1/scenes"] {
        for (fields, kind, named) in [
            (vec![("name", "x")], "invalid-parameter", "-F file=@"),
            (vec![("file", "succeed"), ("file", "succeed")], "invalid-parameter", "file: is given twice"),
            (
                vec![("file", "succeed"), ("name", "a"), ("name", "b")],
                "invalid-parameter",
                "name: is given twice",
            ),
        ] {
            let detail = send(&server, path, form(&fields)).await.expect_problem(422, kind);
            assert!(detail.contains(named), "{detail}");
        }
        let twice = form(&[("file", "succeed"), ("name", "a")]);
        let detail =
            send(&server, &format!("{path}?name=b"), twice).await.expect_problem(422, "invalid-parameter");
        assert!(detail.contains("name: is given twice"), "{detail}");
        for cut in [0, 10, whole.len() - 5] {
            send(&server, path, whole[..cut].to_vec()).await.expect_problem(400, "malformed-form");
        }
        let nameless = String::from_utf8(whole.clone()).expect("text").replace("; name=\"file\"", "");
        send(&server, path, nameless.into_bytes()).await.expect_problem(400, "malformed-form");
        let untyped = server.send("POST", path, |request| {
            request.header("content-type", "multipart/form-data").body(whole.clone())
        });
        untyped.await.expect_problem(400, "malformed-form");
        let mut foreign = form(&[("name", "?"), ("file", "succeed")]);
        let place = foreign.iter().position(|byte| *byte == b'?').expect("there");
        foreign[place] = 0xff;
        let detail = send(&server, path, foreign).await.expect_problem(422, "invalid-parameter");
        assert!(detail.starts_with("name: is not UTF-8"), "{detail}");
        let many = vec![("metadata[a]", "x"); 101];
        send(&server, path, form(&many)).await.expect_problem(422, "invalid-parameter");
        let long = "x".repeat(2 << 20);
        for large in
            [form(&[("name", &long), ("file", "succeed")]), form(&[(&long, "x"), ("file", "succeed")])]
        {
            send(&server, path, large).await.expect_problem(413, "body-too-large");
        }
        send(&server, path, form(&[("file", &long)])).await.expect_problem(413, "body-too-large");
    }
    let unknown = form(&[("file", "succeed"), ("color", "red")]);
    let detail = send(&server, "/v1/jobs", unknown.clone()).await.expect_problem(422, "invalid-option");
    assert!(detail.starts_with("color"), "{detail}");
    send(&server, "/v1/scenes", unknown).await.expect_problem(422, "invalid-parameter");
    let digest = "sha-256=:ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=:";
    let digested = send_as(&server, "/v1/scenes", whole, |request| request.header("content-digest", digest));
    digested.await.expect_problem(400, "invalid-header");
    let datasets = server.get("/v1/datasets").await.expect(200).json();
    assert_eq!(datasets["datasets"], json!([]), "nothing was kept");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_form_is_held_to_the_limits_of_a_body() {
    let coverage = Coverage::default();
    let limits = RequestLimits { upload_bytes: 16, ..Setup::default().limits };
    let server = Server::start_with(&coverage, Setup { limits, ..idle() }).await;
    send(&server, "/v1/jobs", form(&[("file", "succeed 12345678")])).await.expect(201);
    let longer = form(&[("file", "succeed 123456789")]);
    send(&server, "/v1/jobs", longer).await.expect_problem(413, "body-too-large");

    let server = Server::start_with(&coverage, idle()).await;
    let limits = ProjectLimits { quota_bytes: Some(16), ..ProjectLimits::default() };
    let key = server.key_with(&[Scope::Read, Scope::JobsWrite], limits).await;
    let sent = async |dataset: &str| {
        let body = form(&[("file", dataset)]);
        send_as(&server, "/v1/jobs", body, |request| request.bearer_auth(&key.key)).await
    };
    sent("succeed").await.expect(201);
    sent("succeed 123").await.expect_problem(507, "quota-exceeded");
    sent("succeed").await.expect(201);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_form_that_is_sent_again_makes_nothing_again() {
    let server = Server::start_with(&Coverage::default(), idle()).await;
    let keyed = async |fields: &[(&str, &str)]| {
        send_as(&server, "/v1/jobs", form(fields), |request| request.header("idempotency-key", "k")).await
    };
    let first = keyed(&[("file", "succeed"), ("seed", "1")]).await.expect(201);
    let again = keyed(&[("seed", "1"), ("file", "succeed")]).await.expect(201);
    assert_eq!((again.header("idempotency-replayed"), again.json()), ("true", first.json()));
    let other = keyed(&[("file", "succeed"), ("seed", "2")]).await;
    other.expect_problem(422, "idempotency-key-reused");
}

pub(super) async fn a_job_that_came_with_a_dataset_names_it(coverage: Coverage) {
    let server = Server::start(&coverage).await;
    let made = server.upload("", "succeed").await.expect(201);
    let id = made.json()["dataset_id"].as_str().expect("an id").to_owned();
    let dataset = server.get(&format!("/v1/datasets/{id}")).await.expect(200).json();
    assert_eq!((&dataset["kept"], &dataset["dataset"]), (&json!(false), &made.json()["dataset"]));
    let second = server.upload("?seed=1", "succeed").await.expect(201);
    assert_eq!(second.json()["dataset_id"], json!(id), "the same archive");
    let third = server.post_json("/v1/jobs", &json!({ "dataset_id": id, "seed": 2 })).await.expect(201);
    assert_eq!(third.json()["dataset"], made.json()["dataset"]);
    let jobs = server.get(&format!("/v1/jobs?dataset_id={id}")).await.expect(200).json();
    assert_eq!(jobs["jobs"].as_array().map(Vec::len), Some(3));
    let all = [made, second, third].map(|job| job.header("location").to_owned());
    for (index, job) in all.iter().enumerate() {
        server.reaches(job, "succeeded").await;
        server.send("DELETE", job, |request| request).await.expect(204);
        let left = server.get(&format!("/v1/datasets/{id}")).await;
        if index < 2 {
            left.expect(200);
        } else {
            left.expect_problem(404, "scene-not-found");
        }
    }

    let job = server.upload("", "succeed").await.expect(201);
    let kept = server.send("POST", "/v1/datasets?name=garden", |request| {
        request.header("content-type", "application/zip").body("succeed")
    });
    let kept = kept.await.expect(201).json();
    assert_eq!(kept["id"], job.json()["dataset_id"]);
    assert_eq!((&kept["name"], &kept["kept"]), (&json!("garden"), &json!(true)));
    server.reaches(job.header("location"), "succeeded").await;
    server.send("DELETE", job.header("location"), |request| request).await.expect(204);
    let path = kept["links"]["self"].as_str().expect("a path").to_owned();
    server.get(&path).await.expect(200);
    server.send("DELETE", &path, |request| request).await.expect(204);

    let job = server.upload("", "succeed").await.expect(201);
    server.reaches(job.header("location"), "succeeded").await;
    let path = format!("/v1/datasets/{}", job.json()["dataset_id"].as_str().expect("an id"));
    server.send("DELETE", &path, |request| request).await.expect(204);
    let without = server.get(job.header("location")).await.expect(200).json();
    assert_eq!(without["dataset_id"], Value::Null, "it was deleted by name");
}
