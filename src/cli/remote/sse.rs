//! An incremental parser of server-sent events, with a limit on their size.

/// Largest event; those of the service are far smaller.
const MAX_BYTES: usize = 1 << 20;

/// One event.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) id: Option<String>,
    pub(super) data: String,
}

/// The state between two pieces of the stream.
#[derive(Debug, Default)]
pub(super) struct Parser {
    line: Vec<u8>,
    after_return: bool,
    message: Message,
    has_data: bool,
}

/// An event is larger than [`MAX_BYTES`], or the stream has no events.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct TooLong;

impl Parser {
    /// Parses a piece and returns the events that it completes.
    pub(super) fn take(&mut self, piece: &[u8]) -> Result<Vec<Message>, TooLong> {
        let mut complete = Vec::new();
        for &byte in piece {
            // Lines end with LF, CR, or both.
            let after_return = std::mem::replace(&mut self.after_return, byte == b'\r');
            match byte {
                b'\n' if after_return => {}
                b'\n' | b'\r' => {
                    let line = std::mem::take(&mut self.line);
                    complete.extend(self.end_line(&line));
                }
                byte => self.line.push(byte),
            }
            if self.line.len() + self.message.data.len() > MAX_BYTES {
                return Err(TooLong);
            }
        }
        Ok(complete)
    }

    fn end_line(&mut self, line: &[u8]) -> Option<Message> {
        if line.is_empty() {
            let message = std::mem::take(&mut self.message);
            return std::mem::take(&mut self.has_data).then_some(message);
        }
        let line = String::from_utf8_lossy(line);
        let (field, value) = line.split_once(':').unwrap_or((&line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            "data" => {
                if std::mem::replace(&mut self.has_data, true) {
                    self.message.data.push('\n');
                }
                self.message.data.push_str(value);
            }
            "id" if !value.contains('\0') => self.message.id = Some(value.to_owned()),
            _ => {}
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STREAM: &str = "retry: 3000\n\n: keep-alive\n\nid: 1\nevent: state\ndata: {\"a\":1}\n\nid:2\r\ndata: x\r\ndata:y\r\n\r\ndata\r\rid: 9\n";

    fn expected() -> Vec<Message> {
        let message =
            |id: Option<&str>, data: &str| Message { id: id.map(str::to_owned), data: data.to_owned() };
        vec![message(Some("1"), "{\"a\":1}"), message(Some("2"), "x\ny"), message(None, "")]
    }

    #[test]
    fn events_are_the_same_however_the_stream_is_cut() {
        assert_eq!(Parser::default().take(STREAM.as_bytes()), Ok(expected()));
        for size in 1..12 {
            let mut parser = Parser::default();
            let pieces = STREAM.as_bytes().chunks(size);
            let events: Vec<Message> = pieces.flat_map(|piece| parser.take(piece).expect("short")).collect();
            assert_eq!(events, expected(), "pieces of {size}");
        }
    }

    #[test]
    fn an_endless_event_is_refused() {
        let mut parser = Parser::default();
        let mut endless = std::iter::repeat_n([b'x'; 4096], 1 + MAX_BYTES / 4096);
        assert!(endless.any(|piece| parser.take(&piece) == Err(TooLong)));
    }
}
