//! Two API replicas without an adapter behind one address, a worker, and viewers that come, die and leave.

#![cfg(unix)]

use serde_json::{Value, json};

use super::machines::{Machine, Shared};
use crate::support::{
    balancer::Balancer,
    bucket::{S3Server, variables},
    dataset,
    eventually::{eventually, within},
    postgres::Cluster,
    service::Service,
};

/// Requests to the address of all replicas, a connection each.
struct Client {
    base: String,
    client: reqwest::Client,
}

impl Client {
    async fn get(&self, path: &str) -> (u16, reqwest::header::HeaderMap, Vec<u8>) {
        let sent = async {
            loop {
                // A replica that is killed takes its connections with it.
                let Ok(response) = self.client.get(format!("{}{path}", self.base)).send().await else {
                    continue;
                };
                let (status, headers) = (response.status().as_u16(), response.headers().clone());
                if let Ok(body) = response.bytes().await {
                    return (status, headers, body.to_vec());
                }
            }
        };
        within("an answer", sent).await
    }

    async fn file(&self, path: &str) -> Vec<u8> {
        let (status, _, body) = self.get(path).await;
        assert_eq!(status, 200, "{path}: {}", String::from_utf8_lossy(&body));
        body
    }
}

fn viewer(shared: &Shared) -> Machine {
    Machine::start(shared, &["viewer", "--listen", "127.0.0.1:0"])
}

async fn alive(client: &Client, path: &str) {
    eventually("a viewer renders", async || client.get(path).await.0 == 200).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn replicas_without_an_adapter_leave_pictures_to_viewers_that_come_and_go() {
    let (Some(cluster), Some(server)) = (Cluster::shared(), S3Server::shared()) else { return };
    let shared = Shared {
        database: cluster.empty_database().await,
        bucket: server.prefix(),
        variables: variables(server.address),
    };
    let folders = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
    let replica = async |at: usize| {
        // No machine has an adapter of this name.
        let more = ["--workers", "0", "--remote-views", "--adapter", "there is none"];
        Service::start_in(folders[at].path(), more, &shared.environment()).await
    };
    let (one, other) = (replica(0).await, replica(1).await);
    let address = |service: &Service| service.address().parse().expect("an address");
    let balancer = Balancer::start(vec![address(&one), address(&other)]).await;
    let client =
        tcgs::https::client_builder().expect("TLS").pool_max_idle_per_host(0).build().expect("a client");
    let client = Client { base: format!("http://{}", balancer.address), client };

    let job = one.upload("?preset=preview&iterations=60&seed=3", dataset::zip()).await.expect(201);
    let job = job.header("location").to_owned();
    let _worker = Machine::start(&shared, &["worker"]);
    one.succeeded(&job).await;

    let view = format!("{job}/view?width=48&height=32&frame=images/view_06.png");
    let none = one.get(&view).await.expect(503);
    assert_eq!(none.json()["type"], "urn:tcgs:problem:no-viewer");
    assert!(!none.header("retry-after").is_empty());
    one.get(&format!("{job}/export?format=ply")).await.expect(503);

    let mut first = viewer(&shared);
    // Each replica reads the list of viewers at its own times.
    for replica in [&one, &other] {
        eventually("the replica finds the viewer", async || replica.get(&view).await.status == 200).await;
    }
    let (status, headers, picture) = client.get(&view).await;
    assert_eq!((status, headers["content-type"].to_str().expect("ASCII")), (200, "image/png"));
    let exported = client.file(&format!("{job}/export?format=ply")).await;

    // A service that renders by itself gives the same bytes.
    let folder = tempfile::tempdir().expect("a folder");
    let own = Service::start_in(folder.path(), ["--workers", "0"], &shared.environment()).await;
    let same = own.get(&view).await.expect(200);
    assert!(same.body == picture, "the picture of another process differs");
    assert_eq!(same.header("etag"), headers["etag"], "so it has the same tag");
    assert!(own.get(&format!("{job}/export?format=ply")).await.expect(200).body == exported);
    let kinds: Vec<Value> = own.get(&format!("{job}/artifacts")).await.expect(200).json()["artifacts"]
        .as_array()
        .expect("a list")
        .clone();
    let export = kinds.iter().find(|file| file["kind"] == "ply").unwrap_or_else(|| panic!("{kinds:#?}"));
    assert!(export["fidelity"]["psnr"].as_f64().is_some_and(|psnr| psnr > 10.0), "{export:#}");
    own.stop().await;

    let metrics = client.file("/metrics").await;
    let metrics = String::from_utf8(metrics).expect("UTF-8");
    assert!(metrics.contains("\ntcgs_viewers 1.0\n"), "{metrics}");

    // The next pictures are of other views, so that none comes from a cache.
    let at = |place: u32| format!("{job}/view?width={}&height=32&frame=images/view_06.png", 49 + place);
    let mut second = viewer(&shared);
    eventually("the second viewer is announced", async || second.log().contains("rendering views")).await;
    first.cut_power().await;
    alive(&client, &at(1)).await;
    one.kill().await;
    alive(&client, &at(2)).await;
    second.cut_power().await;
    let gone = other.get(&at(3)).await.expect(503);
    assert_eq!(gone.json()["type"], "urn:tcgs:problem:no-viewer");

    let mut third = viewer(&shared);
    alive(&client, &at(4)).await;
    let views = json!({ "views": [{ "frame": "images/view_06.png" }, { "frame": "images/view_00.png" }] });
    let parts = other.post_json(&format!("{job}/views"), &views).await.expect(200);
    assert!(parts.header("content-type").starts_with("multipart/mixed"));
    // A viewer that is told to stop is forgotten before it ends.
    assert!(third.stop().await.success(), "{}", third.log());
    let left = other.get(&at(5)).await.expect(503);
    assert_eq!(left.json()["type"], "urn:tcgs:problem:no-viewer");
    for log in [other.log(), first.log(), second.log(), third.log()] {
        assert!(!log.contains("panicked"), "{log}");
    }
    assert!(other.stop().await.success());
}
