//! Reads JSON from a stream with bounded memory: string length and nesting are limited before the text reaches the parser, which would
//! buffer both.

use std::io::{self, BufRead, Read};

use serde::de::DeserializeOwned;

use super::error::{IngestErrorKind, Result};

/// Longest string in bytes as written, escapes included; a file name of 4096 characters fits in any spelling.
const MAX_STRING_BYTES: usize = 64 << 10;

/// Most brackets open at a time; real files have five.
const MAX_DEPTH: usize = 128;

/// Reads one document.
///
/// # Errors
/// [`IngestErrorKind::Json`], or [`IngestErrorKind::JsonText`] for text that is not given to the parser.
pub(super) fn read<T: DeserializeOwned>(reader: &mut dyn BufRead) -> Result<T> {
    let mut text = Text { reader, line: 1, depth: 0, string: None, refused: None };
    let read = serde_json::from_reader(io::BufReader::new(&mut text));
    match text.refused {
        Some(message) => Err(IngestErrorKind::JsonText { line: text.line, message }),
        None => Ok(read?),
    }
}

/// JSON text on its way to a parser, which judges everything but length and depth.
struct Text<'a> {
    reader: &'a mut dyn BufRead,
    line: usize,
    depth: usize,
    /// Bytes of the string that is open, and whether the next one is escaped.
    string: Option<(usize, bool)>,
    refused: Option<&'static str>,
}

impl Text<'_> {
    fn pass(&mut self, byte: u8) -> Result<(), &'static str> {
        self.line += usize::from(byte == b'\n');
        self.string = match (self.string, byte) {
            (Some((length, _)), _) if length == MAX_STRING_BYTES => {
                return Err("a string is longer than 65536 bytes");
            }
            (Some((_, false)), b'"') => None,
            (Some((length, escaped)), byte) => Some((length + 1, !escaped && byte == b'\\')),
            (None, b'"') => Some((0, false)),
            (None, b'[' | b'{') if self.depth == MAX_DEPTH => {
                return Err("arrays and objects are more than 128 deep");
            }
            (None, b'[' | b'{') => {
                self.depth += 1;
                None
            }
            (None, b']' | b'}') => {
                self.depth = self.depth.saturating_sub(1);
                None
            }
            (None, _) => None,
        };
        Ok(())
    }
}

impl Read for Text<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let count = self.reader.read(into)?;
        for byte in &into[..count] {
            if let Err(message) = self.pass(*byte) {
                self.refused = Some(message);
                return Err(io::Error::other(message));
            }
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use serde::de::IgnoredAny;
    use serde_json::Value;

    use super::*;

    fn parsed(text: &str) -> Result<Value> {
        read(&mut text.as_bytes())
    }

    #[test]
    fn documents_are_read_as_they_are() {
        let text = r#"{"a": ["\"[[[\\", "]}", {"b": null}], "ä": -1.5e3}"#;
        let expected: Value = serde_json::from_str(text).expect("JSON");
        assert_eq!(parsed(text).expect("JSON"), expected);
        assert!(matches!(parsed("[1,"), Err(IngestErrorKind::Json(_))));
        assert!(matches!(parsed("1 2"), Err(IngestErrorKind::Json(_))));
        let deep = format!("{}{}", "[".repeat(100), "]".repeat(100));
        assert!(parsed(&deep).is_ok());
    }

    #[test]
    fn what_a_parser_would_gather_is_refused_with_its_line() {
        let long = format!("[\n\"{}\"]", "a".repeat(MAX_STRING_BYTES + 1));
        let escaped = format!("{{\"{}\": 1}}", "\\u0061".repeat(MAX_STRING_BYTES / 6 + 1));
        let deep = format!("\n{}", "[{\"a\":".repeat(MAX_DEPTH));
        for (text, words) in [
            (long, "line 2: a string is longer"),
            (escaped, "line 1: a string is longer"),
            (deep, "line 2: arrays and objects are more than 128 deep"),
        ] {
            let error = read::<IgnoredAny>(&mut text.as_bytes()).expect_err(words).to_string();
            assert!(error.contains(words), "'{error}' should say '{words}'");
        }
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_text_is_accepted_as_the_parser_alone_would(text in r#"[\[\]{}":,0-9a-z\\ \n]{0,60}"#) {
            let alone = serde_json::from_str::<Value>(&text).ok();
            proptest::prop_assert_eq!(parsed(&text).ok(), alone);
        }
    }
}
