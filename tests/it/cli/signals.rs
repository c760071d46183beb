//! How the program stops when it is told to.

use std::process::Stdio;

use tokio::{
    io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader},
    net::TcpStream,
    process::Command,
};

use crate::support::{
    eventually::{eventually, within},
    program,
    service::{Service, kill},
};

#[tokio::test]
async fn the_second_signal_ends_a_service_that_waits_for_a_client() {
    let data = tempfile::tempdir().expect("a folder");
    let patient = ["--workers", "0", "--drain", "5m", "--body-idle-timeout", "5m"];
    let mut service = Service::start_with(data.path(), patient).await;
    let mut client = TcpStream::connect(service.address()).await.expect("connected");
    let part =
        "POST /v1/jobs HTTP/1.1\r\nhost: x\r\ncontent-type: application/zip\r\ncontent-length: 9\r\n\r\nPK";
    client.write_all(part.as_bytes()).await.expect("sent");
    eventually("the upload is under way", async || {
        let metrics = service.get("/metrics").await.expect(200).body.to_vec();
        String::from_utf8(metrics).expect("UTF-8").contains("\nhttp_active_requests 2\n")
    })
    .await;

    // As `timeout` does it, which means one stop.
    service.ask_to_stop();
    service.ask_to_stop();
    eventually("it stops", async || service.log().contains("stopping")).await;
    assert_eq!(service.ended(), None, "the upload may still come to its end");
    let mut status = None;
    eventually("it has ended", async || {
        status = service.ended();
        if status.is_none() {
            service.ask_to_stop();
        }
        status.is_some()
    })
    .await;
    assert_eq!(status.expect("ended").code(), Some(128 + 15), "{}", service.log());
    // The pipe may be read to its end only after the process is gone.
    eventually("it says so", async || service.log().contains("ending at once")).await;
}

#[tokio::test]
async fn a_service_whose_log_nobody_reads_any_more_still_stops() {
    let data = tempfile::tempdir().expect("a folder");
    let mut command = Command::from(program::command());
    command.args(["serve", "--listen", "127.0.0.1:0", "--workers", "0", "--data"]).arg(data.path());
    let mut service = command.stderr(Stdio::piped()).kill_on_drop(true).spawn().expect("the binary runs");
    let mut log = BufReader::new(service.stderr.take().expect("piped")).lines();
    let listens = async {
        while let Some(line) = log.next_line().await.expect("text") {
            if line.contains("serving on") {
                return true;
            }
        }
        false
    };
    assert!(within("it listens", listens).await);
    drop(log);
    kill("-TERM", service.id().expect("running"));
    let status = within("it has ended", service.wait()).await.expect("ended");
    assert_eq!(status.code(), Some(0));
}
