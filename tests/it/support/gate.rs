//! A TCP proxy before a server, which passes connections on, refuses them, cuts them, passes them on slowly and in small pieces, or delays
//! requests and lets answers on different connections overtake each other.

use std::{
    io,
    net::SocketAddr,
    path::PathBuf,
    sync::{Arc, Mutex},
    time::Duration,
};

use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;
use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _},
    net::{TcpListener, TcpStream, UnixStream},
    sync::watch,
    task::JoinHandle,
    time::{sleep, timeout},
};

/// How long an answer is held if nothing comes on another connection.
const HELD: Duration = Duration::from_millis(60);
/// Longest delay of a request, in microseconds.
const DELAY_MICROS: u64 = 3000;

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
    /// What clients send is delayed, and about half of what the server answers is held until an answer on another connection has
    /// passed, as the seed decides.
    Reordered(u64),
}

/// Where the server is.
#[derive(Debug, Clone)]
pub enum Upstream {
    Tcp(SocketAddr),
    Unix(PathBuf),
}

impl From<SocketAddr> for Upstream {
    fn from(address: SocketAddr) -> Self {
        Self::Tcp(address)
    }
}

/// A connection to the server.
trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<T: AsyncRead + AsyncWrite + Unpin + Send> Stream for T {}

impl Upstream {
    async fn connect(&self) -> io::Result<Box<dyn Stream>> {
        Ok(match self {
            Self::Tcp(address) => Box::new(TcpStream::connect(address).await?),
            Self::Unix(path) => Box::new(UnixStream::connect(path).await?),
        })
    }
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
    pub async fn start(server: impl Into<Upstream>) -> Self {
        let server = server.into();
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let state = Arc::new(Mutex::new(GateState::Open));
        let changed = watch::Sender::new(0);
        let answered = watch::Sender::new(0);
        let mut number = 0;
        let (now, changes) = (Arc::clone(&state), changed.clone());
        let serving = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                let state = *now.lock().expect("not poisoned");
                let mut ends = changes.subscribe();
                number += 1;
                let passage = Passage { server: server.clone(), state, number, answered: answered.clone() };
                tokio::spawn(async move {
                    tokio::select! {
                        _ = ends.changed() => {}
                        _ = passage.pass(client) => {}
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

/// One connection.
struct Passage {
    server: Upstream,
    state: GateState,
    number: u64,
    /// Answers that have passed on all connections.
    answered: watch::Sender<u64>,
}

impl Passage {
    async fn pass(self, mut client: TcpStream) -> io::Result<()> {
        if self.state == GateState::Shut {
            return Ok(());
        }
        let mut server = self.server.connect().await?;
        if self.state == GateState::Open {
            return tokio::io::copy_bidirectional(&mut client, &mut server).await.map(drop);
        }
        let (from_client, to_client) = client.into_split();
        let (from_server, to_server) = tokio::io::split(server);
        tokio::select! {
            ended = self.requests(from_client, to_server) => ended,
            ended = self.answers(from_server, to_client) => ended,
        }
    }

    /// Random numbers of this connection, in one direction.
    fn random(&self, direction: u64) -> Pcg64 {
        let seed = if let GateState::Reordered(seed) = self.state { seed } else { 0 };
        Pcg64::seed_from_u64(seed ^ (2 * self.number + direction).rotate_left(32))
    }

    async fn requests(
        &self,
        mut from: impl AsyncRead + Unpin,
        mut to: impl AsyncWrite + Unpin,
    ) -> io::Result<()> {
        let mut random = self.random(0);
        let mut left = if let GateState::CutAfter(bytes) = self.state { bytes } else { usize::MAX };
        let mut buffer = vec![0; 64 << 10];
        loop {
            let count = from.read(&mut buffer).await?.min(left);
            if count == 0 {
                return Ok(());
            }
            if matches!(self.state, GateState::Reordered(_)) {
                sleep(Duration::from_micros(random.random_range(0..DELAY_MICROS))).await;
            }
            to.write_all(&buffer[..count]).await?;
            to.flush().await?;
            left -= count;
        }
    }

    async fn answers(
        &self,
        mut from: impl AsyncRead + Unpin,
        mut to: impl AsyncWrite + Unpin,
    ) -> io::Result<()> {
        let mut random = self.random(1);
        let mut buffer = vec![0; 65_521];
        loop {
            let count = from.read(&mut buffer).await?;
            if count == 0 {
                return Ok(());
            }
            match self.state {
                GateState::Slow => {
                    sleep(Duration::from_micros(300)).await;
                    for piece in buffer[..count].chunks(7_919) {
                        to.write_all(piece).await?;
                        to.flush().await?;
                    }
                    continue;
                }
                GateState::Reordered(_) if random.random_bool(0.5) => {
                    // While it is held, this connection has no part in the count.
                    let mut others = self.answered.subscribe();
                    let _ = timeout(HELD, others.changed()).await;
                }
                _ => {}
            }
            to.write_all(&buffer[..count]).await?;
            self.answered.send_modify(|count| *count += 1);
        }
    }
}
