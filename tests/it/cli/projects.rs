//! Projects on the command line, and the first key of a service that nobody can run a command beside.

use std::{fs, path::Path};

#[cfg(unix)]
use crate::support::postgres::Cluster;
use crate::support::{
    program::{answers, succeeds, tcgs},
    service::Service,
};

fn at<'a>(data: &'a Path, arguments: &[&'a str]) -> Vec<&'a str> {
    [arguments, &["--data", data.to_str().expect("UTF-8")]].concat()
}

#[test]
fn projects_are_made_and_changed_and_keys_belong_to_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = folder.path();
    let wanted = [
        "projects",
        "create",
        "--json",
        "--name",
        "survey",
        "--quota-bytes",
        "1GiB",
        "--max-running-jobs",
        "2",
    ];
    let made = answers(at(data, &wanted));
    let id = made["id"].as_str().expect("an id");
    assert_eq!((&made["max_bytes"], &made["max_running_jobs"]), (&(1_u64 << 30).into(), &2.into()));
    let key = |name| answers(at(data, &["keys", "create", "--json", "--name", name, "--project", id]));
    let (first, second) = (key("first"), key("second"));
    assert_eq!((&first["project_id"], &second["project_id"]), (&made["id"], &made["id"]));
    answers(at(data, &["keys", "create", "--json", "--name", "apart"]));
    let listed = answers(at(data, &["keys", "list", "--json", "--project", id]));
    assert_eq!(listed["keys"].as_array().map(Vec::len), Some(2));

    let arguments = [
        "projects",
        "change",
        id,
        "--json",
        "--quota-bytes",
        "none",
        "--max-priority",
        "-7",
        "--name",
        "all",
    ];
    let changed = answers(at(data, &arguments));
    assert_eq!((&changed["max_bytes"], &changed["max_priority"]), (&serde_json::Value::Null, &(-7).into()));
    assert_eq!((&changed["name"], &changed["max_running_jobs"]), (&"all".into(), &2.into()));
    let list = answers(at(data, &["projects", "list", "--json"]));
    let names: Vec<_> =
        list["projects"].as_array().expect("projects").iter().map(|one| &one["name"]).collect();
    assert_eq!(names, ["apart", "all", "default"]);
    assert!(succeeds(at(data, &["projects", "list"])).contains("default"));

    let key = first["id"].as_str().expect("an id");
    let expires = [
        "keys",
        "change",
        key,
        "--json",
        "--expires-at",
        "2999-01-31T00:00:00Z",
        "--requests-per-minute",
        "5",
    ];
    let changed = answers(at(data, &expires));
    assert_eq!(
        (&changed["expires_at"], &changed["requests_per_minute"]),
        (&"2999-01-31T00:00:00Z".into(), &5.into())
    );
    let changed = answers(at(data, &["keys", "change", key, "--json", "--expires-at", "none"]));
    assert_eq!((&changed["expires_at"], &changed["name"]), (&serde_json::Value::Null, &"first".into()));

    let absent = "0190a5d8-0000-7000-8000-000000000000";
    for (arguments, status, named) in [
        (&["projects", "create", "--name", " "][..], 2, "name"),
        (&["projects", "change", absent, "--name", "x"], 3, "there is no project"),
        (&["projects", "change", id, "--max-priority", "200"], 2, "max_priority"),
        (&["keys", "create", "--name", "x", "--project", absent], 3, "there is no project"),
        (
            &["keys", "create", "--name", "x", "--project", id, "--max-active-jobs", "3"],
            2,
            "tcgs projects change",
        ),
        (&["keys", "create", "--name", "x", "--expires-at", "2000-01-01T00:00:00Z"], 2, "expires_at"),
        (&["keys", "change", absent, "--name", "x"], 3, "there is no key"),
    ] {
        let output = tcgs(at(data, arguments));
        let shown = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(status), "{arguments:?}: {shown}");
        assert!(shown.contains(named), "{arguments:?}: {shown}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_first_key_is_drawn_into_a_file_or_taken_from_it_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let (data, file) = (folder.path().join("data"), folder.path().join("first.key"));
    let arguments = ["--workers", "0", "--bootstrap-admin-key-file", file.to_str().expect("UTF-8")];
    let ask = async |service: &Service, key: &str| {
        service.send("GET", "/v1/keys", |request| request.bearer_auth(key)).await
    };
    let service = Service::start_with(&data, arguments).await;
    let key = fs::read_to_string(&file).expect("a file").trim().to_owned();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        assert_eq!(file.metadata().expect("there").permissions().mode() & 0o777, 0o600);
    }
    service.get("/v1/jobs").await.expect_problem(401, "no-key");
    let listed = ask(&service, &key).await.expect(200).json();
    assert_eq!(listed["keys"].as_array().map(Vec::len), Some(1));
    assert_eq!(listed["keys"][0]["project_id"], "00000000-0000-0000-0000-000000000000");
    assert!(!service.log().contains(&key[14..]), "the log shows the key");
    service.stop().await;

    // From now on the file is not read: neither a restart nor another key in it makes one more.
    let service = Service::start_with(&data, arguments).await;
    assert_eq!(ask(&service, &key).await.expect(200).json()["keys"].as_array().map(Vec::len), Some(1));
    service.stop().await;
    fs::write(&file, "not a key").expect("written");
    let service = Service::start_with(&data, arguments).await;
    ask(&service, &key).await.expect(200);
    service.stop().await;

    // A key that is there already, as a mounted secret may be, is the first of another service.
    fs::write(&file, format!("  {key}\n\n")).expect("written");
    let other = folder.path().join("other");
    let service = Service::start_with(&other, arguments).await;
    ask(&service, &key).await.expect(200);
    assert_eq!(fs::read_to_string(&file).expect("there").trim(), key, "it is left as it was");
    service.stop().await;

    let secret = format!("{}{}", &key[..key.len() - 1], if key.ends_with('0') { '1' } else { '0' });
    fs::write(&file, &secret).expect("written");
    let fresh = folder.path().join("fresh");
    let refused = tcgs(at(&fresh, &[&["serve", "--listen", "127.0.0.1:0"], &arguments[..]].concat()));
    let shown = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{shown}");
    assert!(shown.contains("--bootstrap-admin-key-file") && !shown.contains(&key[14..40]), "{shown}");
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn replicas_that_start_together_have_one_first_key() {
    let Some(cluster) = Cluster::shared() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let paths = |replica: usize| ["data", "key"].map(|name| folder.path().join(format!("{name}-{replica}")));
    let secret = folder.path().join("secret");
    let drawn = answers(at(folder.path(), &["keys", "create", "--json", "--name", "x", "--scopes", "admin"]));
    fs::write(&secret, drawn["key"].as_str().expect("a key")).expect("written");
    for shared in [None, Some(&secret)] {
        let database = cluster.empty_database().await;
        let environment = [("TCGS_DATABASE", database.url().expose().to_owned())];
        let start = async |replica: usize| {
            let [data, key] = paths(replica);
            let file = shared.unwrap_or(&key).to_str().expect("UTF-8");
            let arguments = ["--workers", "0", "--remote-views", "--bootstrap-admin-key-file", file];
            Service::start_in(&data, arguments, &environment).await
        };
        let (one, two, three) = tokio::join!(start(1), start(2), start(3));
        let files: Vec<_> = (1..=3).map(|replica| paths(replica)[1].clone()).collect();
        let key = match shared {
            Some(secret) => fs::read_to_string(secret),
            None => {
                let left: Vec<_> = files.iter().filter(|file| file.exists()).collect();
                assert_eq!(left.len(), 1, "a file of a key that nobody knows is left");
                fs::read_to_string(left[0])
            }
        };
        let key = key.expect("a file");
        for service in [one, two, three] {
            let keys = service.send("GET", "/v1/keys", |request| request.bearer_auth(key.trim())).await;
            assert_eq!(keys.expect(200).json()["keys"].as_array().map(Vec::len), Some(1));
            service.stop().await;
        }
        for file in files {
            fs::remove_file(file).ok();
        }
    }
}
