//! An endpoint that takes webhooks and answers as it is told to.

use std::{
    net::SocketAddr,
    sync::{Arc, Mutex},
};

use axum::{Router, body::Bytes, http::HeaderMap, response::Response, serve::Listener};
use tokio::{
    net::{TcpListener, TcpStream},
    sync::{Notify, mpsc},
    task::JoinHandle,
};
use tokio_rustls::{TlsAcceptor, server::TlsStream};

use super::eventually::within;

/// A message as it came.
#[derive(Debug, Clone)]
pub struct Received {
    pub path: String,
    pub headers: HeaderMap,
    pub body: Bytes,
}

impl Received {
    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).unwrap_or_else(|| panic!("no {name}")).to_str().expect("ASCII")
    }

    pub fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }
}

/// How messages are answered.
#[derive(Debug, Clone)]
pub enum Manner {
    /// With this status and these headers.
    Status(u16, Vec<(&'static str, String)>),
    /// Not before somebody notifies; then with 200.
    After(Arc<Notify>),
}

/// Connections whose handshake went well; the others are dropped.
struct TlsListener {
    tcp: TcpListener,
    tls: TlsAcceptor,
}

impl Listener for TlsListener {
    type Io = TlsStream<TcpStream>;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        loop {
            let (stream, peer) = Listener::accept(&mut self.tcp).await;
            if let Ok(stream) = self.tls.accept(stream).await {
                return (stream, peer);
            }
        }
    }

    fn local_addr(&self) -> std::io::Result<Self::Addr> {
        self.tcp.local_addr()
    }
}

/// A listening endpoint.
pub struct Receiver {
    pub address: SocketAddr,
    manner: Arc<Mutex<Manner>>,
    received: mpsc::UnboundedReceiver<Received>,
    serving: JoinHandle<()>,
}

impl Receiver {
    pub async fn start() -> Self {
        Self::start_on(|tcp| tcp).await
    }

    /// One that speaks TLS.
    pub async fn start_tls(tls: TlsAcceptor) -> Self {
        Self::start_on(|tcp| TlsListener { tcp, tls }).await
    }

    async fn start_on<L: Listener<Addr: std::fmt::Debug>>(over: impl FnOnce(TcpListener) -> L) -> Self {
        let manner = Arc::new(Mutex::new(Manner::Status(200, Vec::new())));
        let (send, received) = mpsc::unbounded_channel();
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let how = Arc::clone(&manner);
        let take = move |uri: axum::http::Uri, headers: HeaderMap, body: Bytes| async move {
            let manner = how.lock().expect("not poisoned").clone();
            // The test may be over.
            let _ = send.send(Received { path: uri.path().to_owned(), headers, body });
            let (status, headers) = match manner {
                Manner::Status(status, headers) => (status, headers),
                Manner::After(notify) => {
                    notify.notified().await;
                    (200, Vec::new())
                }
            };
            let mut answer = Response::builder().status(status);
            for (name, value) in headers {
                answer = answer.header(name, value);
            }
            answer.body(axum::body::Body::from("taken")).expect("an answer")
        };
        let app = Router::new().fallback(take);
        let listener = over(listener);
        let serving = tokio::spawn(async move { axum::serve(listener, app).await.expect("serves") });
        Self { address, manner, received, serving }
    }

    pub fn answer(&self, manner: Manner) {
        *self.manner.lock().expect("not poisoned") = manner;
    }

    pub fn answer_status(&self, status: u16) {
        self.answer(Manner::Status(status, Vec::new()));
    }

    pub fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address)
    }

    /// A URL that needs a name.
    pub fn https_url(&self, host: &str) -> String {
        format!("https://{host}:{}/", self.address.port())
    }

    /// The next message.
    pub async fn next(&mut self) -> Received {
        within("a message", self.received.recv()).await.expect("the receiver lives")
    }

    /// Whether nothing has come that was not looked at.
    pub fn is_quiet(&mut self) -> bool {
        self.received.try_recv().is_err()
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.serving.abort();
    }
}
