//! The service is killed while a client sends: what it had acknowledged is on disk, and the client goes on from there.

use std::path::{Path, PathBuf};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use reqwest::RequestBuilder;
use serde_json::json;
use sha2::{Digest as _, Sha256};
use tcgs::domain::Digest;
use tokio::{io::AsyncWriteExt as _, net::TcpStream};

use crate::support::{dataset, eventually::eventually, service::Service};

/// A part without a sum is brought to disk and acknowledged each 16 MiB.
const ACKNOWLEDGED: usize = 16 << 20;

/// A client in the middle of an upload.
struct Client<'a> {
    archive: &'a [u8],
    data: &'a Path,
    upload: String,
}

fn tus(request: RequestBuilder) -> RequestBuilder {
    request.header("tus-resumable", "1.0.0")
}

impl<'a> Client<'a> {
    async fn begin(service: &Service, data: &'a Path, archive: &'a [u8]) -> Self {
        let begun = service
            .send("POST", "/v1/uploads", |request| tus(request).header("upload-length", archive.len()));
        let upload = begun.await.expect(201).header("location").to_owned();
        Self { archive, data, upload }
    }

    fn id(&self) -> &str {
        self.upload.rsplit('/').next().expect("an id")
    }

    /// Bytes of the upload's file.
    fn on_disk(&self) -> Vec<u8> {
        std::fs::read(self.file()).unwrap_or_default()
    }

    fn file(&self) -> PathBuf {
        self.data.join("uploads").join(self.id())
    }

    async fn offset(&self, service: &Service) -> usize {
        let answer = service.send("HEAD", &self.upload, tus).await.expect(200);
        answer.header("upload-offset").parse().expect("a number")
    }

    /// Sends bytes `from..until` of a part that was to go to the archive's end; returns once all of them are in the file.
    async fn half_a_part(&self, service: &Service, from: usize, until: usize, more: &str) -> TcpStream {
        let mut stream = TcpStream::connect(service.address()).await.expect("connected");
        let head = format!(
            "PATCH {} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nContent-Type: application/offset+octet-stream\r\n\
             Upload-Offset: {from}\r\nContent-Length: {}\r\n{more}\r\n",
            self.upload,
            self.archive.len() - from,
        );
        stream.write_all(head.as_bytes()).await.expect("sent");
        stream.write_all(&self.archive[from..until]).await.expect("sent");
        let length = || std::fs::metadata(self.file()).map_or(0, |file| file.len());
        eventually("the bytes are in the file", async || length() >= until as u64).await;
        stream
    }

    /// Sends the rest and makes a scene of the whole.
    async fn finish(&self, service: &Service, from: usize) {
        let rest = self.archive[from..].to_vec();
        let sent = service.send("PATCH", &self.upload, |request| {
            let request = tus(request).header("content-type", "application/offset+octet-stream");
            request.header("upload-offset", from).body(rest)
        });
        assert_eq!(sent.await.expect(204).header("upload-offset"), self.archive.len().to_string());
        let scene =
            service.post_json("/v1/scenes", &json!({ "upload_id": self.id() })).await.expect(201).json();
        let digest = Digest::of(self.archive).to_string();
        assert_eq!(scene["dataset"]["sha256"], digest, "{scene:#}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upload_goes_on_from_what_was_acknowledged_before_the_service_was_killed() {
    let archive = dataset::padded_zip(ACKNOWLEDGED + (8 << 20));
    let data = tempfile::tempdir().expect("a folder");
    let begin = || Service::start_with(data.path(), ["--workers", "0"]);

    let service = begin().await;
    let client = Client::begin(&service, data.path(), &archive).await;
    let sent = ACKNOWLEDGED + (4 << 20);
    let stream = client.half_a_part(&service, 0, sent, "").await;
    // What is acknowledged while the part is still on its way.
    eventually("a part is acknowledged", async || client.offset(&service).await >= ACKNOWLEDGED).await;
    service.kill().await;
    drop(stream);

    let service = begin().await;
    let kept = client.offset(&service).await;
    assert!((ACKNOWLEDGED..=sent).contains(&kept), "{kept} of {sent} bytes");
    assert_eq!(client.on_disk()[..kept], archive[..kept], "and they are there");

    // A part with a sum counts whole or not at all.
    let sum = STANDARD.encode(Sha256::digest(&archive[kept..]));
    let sum = format!("Upload-Checksum: sha256 {sum}\r\n");
    let stream = client.half_a_part(&service, kept, archive.len() - 1000, &sum).await;
    service.kill().await;
    drop(stream);

    let service = begin().await;
    assert_eq!(client.offset(&service).await, kept);
    client.finish(&service, kept).await;
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_archive_that_was_half_sent_when_the_service_was_killed_leaves_nothing() {
    let archive = dataset::zip();
    let data = tempfile::tempdir().expect("a folder");
    let service = Service::start_with(data.path(), ["--workers", "0"]).await;
    let mut stream = TcpStream::connect(service.address()).await.expect("connected");
    let head = format!(
        "POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/zip\r\nContent-Length: {}\r\n\r\n",
        archive.len()
    );
    stream.write_all(head.as_bytes()).await.expect("sent");
    stream.write_all(&archive[..archive.len() / 2]).await.expect("sent");
    // Each process stages in a folder of its own.
    let staged = || {
        let rooms = std::fs::read_dir(data.path().join("staging")).expect("a folder");
        let files =
            rooms.flat_map(|room| std::fs::read_dir(room.expect("an entry").path()).expect("a folder"));
        files.filter(|file| file.as_ref().expect("an entry").file_name() != "held").count()
    };
    eventually("a staged file", async || staged() > 0).await;
    service.kill().await;
    drop(stream);
    assert!(staged() > 0, "nobody cleared it away");

    let service = Service::start_with(data.path(), ["--workers", "0"]).await;
    assert_eq!(staged(), 0);
    assert_eq!(service.get("/v1/jobs").await.expect(200).json()["jobs"], json!([]));
    service.upload("", archive).await.expect(201);
    service.stop().await;
}
