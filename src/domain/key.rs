//! API keys.
//!
//! A key is `tcgs_`, forty random hex digits (160 bits) and eight of CRC-32C over the text before them. So secret scanners find
//! leaked keys, and a mistyped key is recognized without a look into the database. Neither a key nor its hash is printed except by
//! the two `expose` methods.

use std::{fmt, str::FromStr};

use secrecy::{ExposeSecret as _, SecretString};
use subtle::ConstantTimeEq as _;
use thiserror::Error;

use super::{
    Digest, RandomSource,
    random_source::{RandomError, random_digits},
};

/// The prefix of every key.
pub const KEY_PREFIX: &str = "tcgs_";

const RANDOM_BYTES: usize = 20;
const KEY_LENGTH: usize = KEY_PREFIX.len() + 2 * RANDOM_BYTES + 8;
/// Hex digits after the prefix that may be shown; 128 random bits stay hidden.
const SHOWN_DIGITS: usize = 8;

/// A whole key.
#[derive(Debug, Clone)]
pub struct ApiKey(SecretString);

/// A string that cannot be a key. It does not hold the string, which may be a key with a typing error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("an API key is '{KEY_PREFIX}' and 48 hexadecimal digits, the last eight of which are a check sum")]
pub struct MalformedKey;

impl ApiKey {
    /// A new key.
    ///
    /// # Errors
    /// [`RandomError`].
    pub fn generate(entropy: &dyn RandomSource) -> Result<Self, RandomError> {
        let digits = random_digits::<RANDOM_BYTES>(entropy)?;
        let body = format!("{KEY_PREFIX}{digits}");
        let sum = crc32c::crc32c(body.as_bytes());
        Ok(Self(format!("{body}{sum:08x}").into()))
    }

    /// The key itself, to show to its holder once.
    #[must_use]
    pub fn expose(&self) -> &str {
        self.0.expose_secret()
    }

    /// Its first characters, which identify it without revealing it.
    #[must_use]
    pub fn prefix(&self) -> &str {
        &self.expose()[..KEY_PREFIX.len() + SHOWN_DIGITS]
    }

    /// The hash that is stored.
    #[must_use]
    pub fn hash(&self) -> KeyHash {
        KeyHash::of(self.expose())
    }
}

impl FromStr for ApiKey {
    type Err = MalformedKey;

    fn from_str(text: &str) -> Result<Self, MalformedKey> {
        let digits = text.strip_prefix(KEY_PREFIX).ok_or(MalformedKey)?;
        let hex = digits.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
        if text.len() != KEY_LENGTH || !hex {
            return Err(MalformedKey);
        }
        let (body, sum) = text.split_at(KEY_LENGTH - 8);
        if u32::from_str_radix(sum, 16) != Ok(crc32c::crc32c(body.as_bytes())) {
            return Err(MalformedKey);
        }
        Ok(Self(text.into()))
    }
}

/// SHA-256 of a key, or of a session's token. Both are random and long, so a slow hash would protect nothing more.
#[derive(Clone, Copy)]
pub struct KeyHash(Digest);

impl KeyHash {
    /// Of a secret that is random and long.
    pub(super) fn of(secret: &str) -> Self {
        Self(Digest::of(secret.as_bytes()))
    }

    /// The hash as 64 hex digits, for the database.
    #[must_use]
    pub fn expose(&self) -> String {
        self.0.to_string()
    }

    /// Whether `stored` is this hash, compared in constant time.
    #[must_use]
    pub fn is(&self, stored: &str) -> bool {
        self.expose().as_bytes().ct_eq(stored.as_bytes()).into()
    }
}

impl fmt::Debug for KeyHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("KeyHash([REDACTED])")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Counting;

    impl RandomSource for Counting {
        fn fill(&self, bytes: &mut [u8]) -> Result<(), RandomError> {
            for (index, byte) in bytes.iter_mut().enumerate() {
                *byte = u8::try_from(index).expect("few");
            }
            Ok(())
        }
    }

    fn key() -> ApiKey {
        ApiKey::generate(&Counting).expect("a key")
    }

    #[test]
    fn a_key_can_be_read_back_and_its_form_is_for_good() {
        let text = key().expose().to_owned();
        assert_eq!(text, "tcgs_000102030405060708090a0b0c0d0e0f10111213b57d5e69");
        let read: ApiKey = text.parse().expect("a key");
        assert!(read.hash().is(&key().hash().expose()));
        assert_eq!(read.prefix(), "tcgs_00010203");
    }

    #[test]
    fn whatever_is_not_a_key_is_refused_without_being_repeated() {
        let good = key().expose().to_owned();
        let slip = good.replacen('1', "2", 1);
        let long = format!("{good}0");
        let faults = ["", "tcgs_", &good[5..], &good[..52], &slip, &long, &good.to_uppercase(), "tcgs_é"];
        for text in faults {
            let error = text.parse::<ApiKey>().expect_err(text);
            assert!(text.len() < 6 || !error.to_string().contains(text), "{error}");
        }
    }

    #[test]
    fn debug_output_shows_neither_key_nor_hash() {
        let shown = format!("{:?} {:?}", key(), key().hash());
        assert!(!shown.contains("000102") && !shown.contains(&key().hash().expose()[..8]), "{shown}");
    }

    #[test]
    fn hashes_are_told_apart() {
        let hash = key().hash();
        assert!(hash.is(&hash.expose()));
        assert!(!hash.is(&Digest::of(b"another").to_string()));
        assert!(!hash.is(""));
    }
}
