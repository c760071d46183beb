//! Addresses to listen on, as people write them.

use std::net::{Ipv4Addr, SocketAddr};

/// The address in `text`: an IP address or `localhost`, and a port.
///
/// # Errors
/// What is wrong, for clap.
pub(crate) fn listen_address(text: &str) -> Result<SocketAddr, String> {
    if let Ok(address) = text.parse() {
        return Ok(address);
    }
    let port = |text: &str| text.parse::<u16>().ok();
    if let Some(port) = text.strip_prefix("localhost:").and_then(port) {
        return Ok((Ipv4Addr::LOCALHOST, port).into());
    }
    let example = match port(text.trim_start_matches(':')) {
        Some(port) => format!("127.0.0.1:{port}"),
        None => "127.0.0.1:8080, localhost:8080 or [::1]:8080".to_owned(),
    };
    Err(format!("an address and a port are needed, such as {example}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_as_people_write_them() {
        for (text, address) in [
            ("127.0.0.1:19003", "127.0.0.1:19003"),
            ("localhost:19003", "127.0.0.1:19003"),
            ("[::1]:0", "[::1]:0"),
        ] {
            assert_eq!(listen_address(text), Ok(address.parse().expect("an address")), "{text}");
        }
        for (text, hint) in [
            ("19003", "such as 127.0.0.1:19003"),
            (":19003", "such as 127.0.0.1:19003"),
            ("localhost", "localhost:8080"),
            ("localhost:70000", "localhost:8080"),
            ("example.com:80", "127.0.0.1:8080"),
        ] {
            let error = listen_address(text).expect_err(text);
            assert!(error.contains(hint), "{error}");
        }
    }
}
