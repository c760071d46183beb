//! One address before several servers: a TCP proxy that gives each connection to the next of them that takes it.

use std::{
    net::SocketAddr,
    sync::atomic::{AtomicUsize, Ordering},
};

use tokio::{
    io::copy_bidirectional,
    net::{TcpListener, TcpStream},
    task::JoinHandle,
};

/// A running proxy.
pub struct Balancer {
    pub address: SocketAddr,
    serving: JoinHandle<()>,
}

impl Balancer {
    /// Takes connections for `servers`.
    pub async fn start(servers: Vec<SocketAddr>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let serving = tokio::spawn(async move {
            let next = AtomicUsize::new(0);
            while let Ok((client, _)) = listener.accept().await {
                let first = next.fetch_add(1, Ordering::Relaxed) % servers.len();
                let order: Vec<SocketAddr> =
                    servers[first..].iter().chain(&servers[..first]).copied().collect();
                tokio::spawn(pass(client, order));
            }
        });
        Self { address, serving }
    }
}

impl Drop for Balancer {
    fn drop(&mut self) {
        self.serving.abort();
    }
}

async fn pass(mut client: TcpStream, servers: Vec<SocketAddr>) {
    for server in servers {
        if let Ok(mut server) = TcpStream::connect(server).await {
            // A connection that breaks is the client's to repeat.
            let _ = copy_bidirectional(&mut client, &mut server).await;
            return;
        }
    }
}
