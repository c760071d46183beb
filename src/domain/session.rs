//! Sessions of browsers: random tokens that stand for a key. The database has their hashes alone, and none is printed except by
//! [`SessionToken::expose`].

use std::str::FromStr;

use secrecy::{ExposeSecret as _, SecretString};

use super::{KeyHash, RandomError, RandomSource, random_source::random_digits};

/// Random bytes of a token.
const RANDOM_BYTES: usize = 32;

/// A token: hexadecimal digits.
#[derive(Debug, Clone)]
pub struct SessionToken(SecretString);

/// A string that cannot be a token; it is not kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MalformedSession;

impl SessionToken {
    /// A new token.
    ///
    /// # Errors
    /// [`RandomError`].
    pub fn generate(entropy: &dyn RandomSource) -> Result<Self, RandomError> {
        Ok(Self(random_digits::<RANDOM_BYTES>(entropy)?.into()))
    }

    /// The token itself, for its browser.
    #[must_use]
    pub fn expose(&self) -> &str {
        self.0.expose_secret()
    }

    /// The hash that is stored.
    #[must_use]
    pub fn hash(&self) -> KeyHash {
        KeyHash::of(self.expose())
    }
}

impl FromStr for SessionToken {
    type Err = MalformedSession;

    fn from_str(text: &str) -> Result<Self, MalformedSession> {
        let is_hex = text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
        if text.len() == 2 * RANDOM_BYTES && is_hex { Ok(Self(text.into())) } else { Err(MalformedSession) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_64_digits_and_is_not_printed() {
        let text = "0a".repeat(32);
        let token: SessionToken = text.parse().expect("a token");
        assert_eq!(token.expose(), text);
        assert!(!format!("{token:?} {:?}", token.hash()).contains("0a0a"));
        for bad in ["", &text[1..], &format!("{text}0"), &text.to_uppercase(), &text.replace('0', " ")] {
            assert!(bad.parse::<SessionToken>().is_err(), "{bad}");
        }
    }
}
