//! Reading event streams as the standard says.

use bytes::{Bytes, BytesMut};
use serde_json::Value;

use super::eventually::within;

/// An event of a stream.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Frame {
    pub id: String,
    pub event: String,
    pub data: String,
}

impl Frame {
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.data).expect("JSON")
    }

    pub fn number(&self) -> u64 {
        self.id.parse().expect("a number")
    }
}

/// The events of a whole stream; blocks without data are none.
pub fn frames(body: &[u8]) -> Vec<Frame> {
    let text = std::str::from_utf8(body).expect("UTF-8");
    text.split("\n\n").map(frame).filter(|frame| !frame.data.is_empty()).collect()
}

fn frame(block: &str) -> Frame {
    let mut frame = Frame::default();
    for line in block.lines() {
        let (name, value) = line.split_once(':').unwrap_or((line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match name {
            "id" => frame.id = value.to_owned(),
            "event" => frame.event = value.to_owned(),
            "data" => frame.data.push_str(value),
            _ => {}
        }
    }
    frame
}

/// A stream that is being read.
pub struct Reader {
    response: reqwest::Response,
    unread: BytesMut,
}

impl Reader {
    pub fn new(response: reqwest::Response) -> Self {
        Self { response, unread: BytesMut::new() }
    }

    pub fn response(&self) -> &reqwest::Response {
        &self.response
    }

    /// The next block, whatever it holds; `None` at the end, and where the connection breaks.
    pub async fn block(&mut self) -> Option<Bytes> {
        loop {
            if let Some(end) = self.unread.windows(2).position(|pair| pair == b"\n\n") {
                return Some(self.unread.split_to(end + 2).freeze());
            }
            let chunk = within("the next event", self.response.chunk()).await;
            self.unread.extend_from_slice(&chunk.ok()??);
        }
    }

    /// The next event.
    pub async fn next(&mut self) -> Option<Frame> {
        loop {
            if let Some(frame) = frames(&self.block().await?).pop() {
                return Some(frame);
            }
        }
    }
}
