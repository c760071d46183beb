//! A TCP proxy before a server, which passes connections on, refuses them, cuts them, or passes them on slowly and in small pieces.

use std::{
    io,
    net::SocketAddr,
    sync::{Arc, Mutex},
    time::Duration,
};

use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{TcpListener, TcpStream},
    sync::watch,
    task::JoinHandle,
};

/// What happens to connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GateState {
    /// They are passed on.
    Open,
    /// They end at once, also those that there are.
    Shut,
    /// The server gets so many bytes of each, and then it ends, also those that there are.
    CutAfter(usize),
    /// They are passed on in pieces of odd lengths with pauses.
    Slow,
}

/// A running proxy.
pub struct Gate {
    pub address: SocketAddr,
    state: Arc<Mutex<GateState>>,
    changed: watch::Sender<u32>,
    serving: JoinHandle<()>,
}

impl Gate {
    /// Stands open before `server`.
    pub async fn start(server: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let state = Arc::new(Mutex::new(GateState::Open));
        let changed = watch::Sender::new(0);
        let (now, changes) = (Arc::clone(&state), changed.clone());
        let serving = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                let state = *now.lock().expect("not poisoned");
                let mut ends = changes.subscribe();
                tokio::spawn(async move {
                    tokio::select! {
                        _ = ends.changed() => {}
                        _ = pass(client, server, state) => {}
                    }
                });
            }
        });
        Self { address, state, changed, serving }
    }

    /// What happens from now on. Connections that there are end.
    pub fn set(&self, state: GateState) {
        *self.state.lock().expect("not poisoned") = state;
        self.changed.send_modify(|count| *count += 1);
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        self.serving.abort();
    }
}

async fn pass(mut client: TcpStream, server: SocketAddr, state: GateState) -> io::Result<()> {
    if state == GateState::Shut {
        return Ok(());
    }
    let mut server = TcpStream::connect(server).await?;
    if matches!(state, GateState::Open) {
        return tokio::io::copy_bidirectional(&mut client, &mut server).await.map(drop);
    }
    let (mut from_client, mut to_client) = client.split();
    let (mut from_server, mut to_server) = server.split();
    let up = async {
        let (mut left, mut buffer) = (usize::MAX, vec![0; 64 << 10]);
        if let GateState::CutAfter(bytes) = state {
            left = bytes;
        }
        loop {
            let count = from_client.read(&mut buffer).await?.min(left);
            if count == 0 {
                return Ok::<(), io::Error>(());
            }
            to_server.write_all(&buffer[..count]).await?;
            left -= count;
        }
    };
    let down = async {
        let mut buffer = vec![0; 65_521];
        loop {
            let count = from_server.read(&mut buffer).await?;
            if count == 0 {
                return Ok::<(), io::Error>(());
            }
            if state == GateState::Slow {
                tokio::time::sleep(Duration::from_micros(300)).await;
                for piece in buffer[..count].chunks(7_919) {
                    to_client.write_all(piece).await?;
                    to_client.flush().await?;
                }
            } else {
                to_client.write_all(&buffer[..count]).await?;
            }
        }
    };
    tokio::select! {
        ended = up => ended,
        ended = down => ended,
    }
}
