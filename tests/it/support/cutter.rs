//! A proxy that breaks connections at a byte that a test chooses, within a request or within an answer.

use std::{
    io,
    net::SocketAddr,
    sync::{Arc, Mutex},
};

use tokio::{
    io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader},
    net::{TcpListener, TcpStream},
    task::JoinHandle,
};

/// What happens to a request.
#[derive(Debug, Clone, Copy)]
pub enum Fault {
    /// The service gets so many bytes of it, and nobody an answer.
    Request(usize),
    /// The client gets so many bytes of the answer.
    Answer(usize),
    /// The service gets nothing, the client this.
    Says(&'static str),
}

/// A fault for one request whose first line has `target` in it.
#[derive(Debug, Clone, Copy)]
pub struct Rule {
    pub target: &'static str,
    pub error: Fault,
}

/// A running proxy.
pub struct Cutter {
    pub address: SocketAddr,
    rules: Arc<Mutex<Vec<Rule>>>,
    serving: JoinHandle<()>,
}

impl Cutter {
    /// Stands before `service`. A request meets the first rule that is for it, which is then used up.
    pub async fn start(service: SocketAddr, rules: Vec<Rule>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let rules = Arc::new(Mutex::new(rules));
        let kept = Arc::clone(&rules);
        let serving = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                tokio::spawn(pass(client, service, Arc::clone(&kept)));
            }
        });
        Self { address, rules, serving }
    }

    /// Rules that no request has met.
    pub fn left(&self) -> usize {
        self.rules.lock().expect("not poisoned").len()
    }
}

impl Drop for Cutter {
    fn drop(&mut self) {
        self.serving.abort();
    }
}

/// Passes one request and its answer, so that bytes are counted from the beginning of each.
async fn pass(client: TcpStream, service: SocketAddr, rules: Arc<Mutex<Vec<Rule>>>) -> io::Result<()> {
    let mut client = BufReader::new(client);
    let (mut head, mut length) = (String::new(), 0);
    loop {
        let mut line = String::new();
        if client.read_line(&mut line).await? == 0 {
            return Ok(());
        }
        let lower = line.to_ascii_lowercase();
        if let Some(value) = lower.strip_prefix("content-length:") {
            length = value.trim().parse().expect("a length");
        }
        if line == "\r\n" {
            break;
        }
        if !lower.starts_with("connection:") {
            head.push_str(&line);
        }
    }
    head.push_str("Connection: close\r\n\r\n");
    let error = {
        let first = head.lines().next().unwrap_or_default();
        let mut rules = rules.lock().expect("not poisoned");
        let place = rules.iter().position(|rule| first.contains(rule.target));
        place.map(|place| rules.remove(place).error)
    };
    let mut request = head.into_bytes();
    if let Some(Fault::Request(bytes)) = error {
        length = length.min(bytes.saturating_sub(request.len()));
        request.truncate(bytes);
    }
    let mut body = vec![0; length];
    client.read_exact(&mut body).await?;
    if let Some(Fault::Says(answer)) = error {
        return client.write_all(answer.as_bytes()).await;
    }
    let mut upstream = TcpStream::connect(service).await?;
    upstream.write_all(&request).await?;
    upstream.write_all(&body).await?;
    let mut left = match error {
        Some(Fault::Request(_)) => return Ok(()),
        Some(Fault::Answer(bytes)) => bytes,
        _ => usize::MAX,
    };
    let mut buffer = vec![0; 4096];
    while left > 0 {
        let read = upstream.read(&mut buffer).await?.min(left);
        if read == 0 {
            break;
        }
        client.write_all(&buffer[..read]).await?;
        left -= read;
    }
    client.shutdown().await
}
