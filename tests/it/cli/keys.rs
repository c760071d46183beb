//! Keys on the command line, beside a service that runs.

use tcgs::sample::{self, Settings};

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

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_first_key_says_what_it_changes_and_the_default_project_is_known_by_name() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let data = folder.path().join("data");
    let service = Service::start_with(&data, ["--workers", "0"]).await;
    let archive = folder.path().join("scene.zip");
    sample::write(&archive, &Settings { points: 50, ..Settings::square(16) }).expect("written");
    service.upload("", std::fs::read(archive).expect("readable")).await.expect(201);
    let create = |arguments: &[&str]| {
        let data = data.display().to_string();
        let output =
            tcgs([&["keys", "create", "--name", "me"], arguments, &["--data", &data, "--json"]].concat());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        let made: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        (made["key"].as_str().expect("a key").to_owned(), said)
    };
    let jobs = async |key: &str| {
        let answer = service.send("GET", "/v1/jobs", |request| request.bearer_auth(key)).await.expect(200);
        answer.json()["jobs"].as_array().expect("jobs").len()
    };
    let (own, said) = create(&[]);
    for words in ["every request needs a key", "1 job is of the project default", "--project default"] {
        assert!(said.contains(words), "'{said}' should say '{words}'");
    }
    assert_eq!(jobs(&own).await, 0);
    let (shared, said) = create(&["--project", "default"]);
    assert_eq!((jobs(&shared).await, said.as_str()), (1, ""));
    let list =
        answers(["keys", "list", "--json", "--project", "default", "--data", &data.display().to_string()]);
    assert_eq!(list["keys"].as_array().expect("keys").len(), 1);
    let unknown =
        tcgs(["keys", "create", "--name", "x", "--project", "mine", "--data", &data.display().to_string()]);
    assert_eq!(unknown.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("tcgs projects list"), "{unknown:?}");
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
