//! Keys on the command line, beside a service that runs.

use crate::support::{
    program::{answers, succeeds, tcgs},
    service::Service,
};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keys_are_made_and_revoked_beside_a_running_service() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let data = folder.path().join("data");
    let in_data = |arguments: &[&str]| {
        let mut all: Vec<String> = arguments.iter().map(|&argument| argument.to_owned()).collect();
        all.extend(["--data".to_owned(), data.display().to_string()]);
        all
    };
    let service = Service::start_with(&data, ["--workers", "0"]).await;
    service.get("/v1/jobs").await.expect(200);

    let made = answers(in_data(&[
        "keys",
        "create",
        "--json",
        "--name",
        "CI",
        "--scopes",
        "read",
        "--quota-bytes",
        "1GiB",
    ]));
    let (id, key) = (made["id"].as_str().expect("an id"), made["key"].as_str().expect("a key"));
    assert_eq!(made["scopes"], serde_json::json!(["read"]));
    let projects = answers(in_data(&["projects", "list", "--json"]));
    let own = projects["projects"].as_array().expect("projects").iter();
    let own = own.clone().find(|project| project["project_id"] == made["project_id"]).expect("its project");
    assert_eq!((&own["limits"]["max_bytes"], &own["name"]), (&(1_u64 << 30).into(), &"CI".into()));
    service.get("/v1/jobs").await.expect_problem(401, "no-key");
    let ask = async || service.send("GET", "/v1/jobs", |request| request.bearer_auth(key)).await;
    ask().await.expect(200);

    let list = answers(in_data(&["keys", "list", "--json"]));
    assert_eq!(list["keys"][0]["id"], id);
    assert!(!list.to_string().contains(key) && !list.to_string().contains("hash"));
    assert!(succeeds(in_data(&["keys", "list"])).contains("CI"));
    let revoked = answers(in_data(&["keys", "revoke", id, "--json"]));
    assert!(revoked["revoked_at"].is_string());
    ask().await.expect_problem(401, "invalid-key");
    assert_eq!(answers(in_data(&["keys", "list", "--json"]))["keys"], serde_json::json!([]));
    assert!(succeeds(in_data(&["keys", "list", "--all"])).contains("revoked"));
    assert!(!service.log().contains(&key[14..]), "the log shows the key");
    drop(service);

    let service = Service::start_with(&data, ["--workers", "0"]).await;
    service.get("/v1/jobs").await.expect_problem(401, "no-key");
    drop(service);
    let service = Service::start_with(&data, ["--workers", "0", "--without-keys"]).await;
    service.get("/v1/jobs").await.expect(200);
    drop(service);
    let exposed = tcgs(in_data(&["serve", "--listen", "0.0.0.0:0", "--without-keys"]));
    assert_eq!(exposed.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&exposed.stderr).contains("--without-keys"));
}

#[test]
fn what_is_wrong_with_a_key_is_said() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let data = folder.path().display().to_string();
    let missing = "there is no database";
    let cases: [(&[&str], i32, &str); 7] = [
        (&["list"], 3, missing),
        (&["revoke", "0190a5d8-0000-7000-8000-000000000000"], 3, missing),
        (&["create", "--name", "first"], 0, "it is new"),
        (&["create", "--name", " "], 2, "name"),
        (&["create", "--name", "x", "--scopes", "write"], 2, "scenes:write"),
        (&["revoke", "17"], 2, "17"),
        (&["revoke", "0190a5d8-0000-7000-8000-000000000000"], 3, "there is no key"),
    ];
    for (arguments, status, named) in cases {
        let output = tcgs([&["keys"], arguments, &["--data", &data]].concat());
        assert_eq!(output.status.code(), Some(status), "{arguments:?}");
        let shown = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(shown.contains(named), "{arguments:?}: {shown}");
    }
}
