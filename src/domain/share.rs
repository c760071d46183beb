//! Tokens of shared links, signed by a secret that the database has. Neither a secret nor a token is printed, except by their `expose`.

use std::str::FromStr;

use hmac::{Hmac, KeyInit, Mac as _};
use secrecy::{ExposeSecret as _, SecretString};
use sha2::Sha256;
use subtle::ConstantTimeEq as _;
use uuid::Uuid;

use super::{
    RandomError, RandomSource, ShareId,
    random_source::{hex, random_digits},
};

/// Random bytes of a secret.
const RANDOM_BYTES: usize = 32;
/// Bytes of a signature: half of the hash, which cannot be guessed either.
const SIGNATURE_BYTES: usize = 16;
/// The block of SHA-256.
const BLOCK_BYTES: usize = 64;
/// Digits of an identity.
const ID_DIGITS: usize = 32;

/// What tokens are signed with: hexadecimal digits.
#[derive(Debug, Clone)]
pub struct ShareSecret(SecretString);

impl ShareSecret {
    /// A new secret.
    ///
    /// # Errors
    /// [`RandomError`].
    pub fn generate(entropy: &dyn RandomSource) -> Result<Self, RandomError> {
        Ok(Self(random_digits::<RANDOM_BYTES>(entropy)?.into()))
    }

    /// A secret as it was stored.
    #[must_use]
    pub fn stored(text: String) -> Self {
        Self(text.into())
    }

    /// The secret itself, for the database.
    #[must_use]
    pub fn expose(&self) -> &str {
        self.0.expose_secret()
    }

    /// The token of a link: its identity and the signature.
    #[must_use]
    pub fn sign(&self, id: ShareId) -> ShareToken {
        let signature = self.mac(id).finalize().into_bytes();
        ShareToken { id, signature: hex(&signature[..SIGNATURE_BYTES]).into() }
    }

    /// Whether this secret has signed the token; the time does not depend on where they differ.
    #[must_use]
    pub fn has_signed(&self, token: &ShareToken) -> bool {
        let own = self.sign(token.id);
        own.signature.expose_secret().as_bytes().ct_eq(token.signature.expose_secret().as_bytes()).into()
    }

    fn mac(&self, id: ShareId) -> Hmac<Sha256> {
        // HMAC fills shorter keys with zeros up to the hash's block; a secret's digits are that many.
        let mut key = [0; BLOCK_BYTES];
        for (place, digit) in key.iter_mut().zip(self.expose().bytes()) {
            *place = digit;
        }
        let mut mac = <Hmac<Sha256> as KeyInit>::new(&key.into());
        mac.update(b"tcgs share ");
        mac.update(id.0.as_bytes());
        mac
    }
}

/// The part of a link that lets its holder in.
#[derive(Debug, Clone)]
pub struct ShareToken {
    /// The link's identity.
    pub id: ShareId,
    signature: SecretString,
}

/// A string that cannot be a token; it is not kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MalformedShareToken;

impl ShareToken {
    /// The token itself: digits of the identity, then of the signature.
    #[must_use]
    pub fn expose(&self) -> String {
        format!("{}{}", self.id.0.simple(), self.signature.expose_secret())
    }
}

impl FromStr for ShareToken {
    type Err = MalformedShareToken;

    fn from_str(text: &str) -> Result<Self, MalformedShareToken> {
        let is_hex = text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
        if text.len() != ID_DIGITS + 2 * SIGNATURE_BYTES || !is_hex {
            return Err(MalformedShareToken);
        }
        let (id, signature) = text.split_at(ID_DIGITS);
        let id = ShareId(Uuid::try_parse(id).map_err(|_| MalformedShareToken)?);
        Ok(Self { id, signature: signature.into() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_of_one_link_and_one_secret() {
        let [secret, other] = ["a1", "b2"].map(|text| ShareSecret::stored(text.repeat(32)));
        let id = ShareId(Uuid::from_u128(7));
        let token = secret.sign(id);
        let read: ShareToken = token.expose().parse().expect("a token");
        assert_eq!(read.id, id);
        assert!(secret.has_signed(&read) && !other.has_signed(&read));
        let next: ShareToken = token.expose().replacen("07", "08", 1).parse().expect("a token");
        assert!(next.id != id && !secret.has_signed(&next), "a signature is of one link");
        let shown = format!("{secret:?} {token:?}");
        assert!(!shown.contains("a1a1") && !shown.contains(&token.expose()[ID_DIGITS..]), "{shown}");
    }

    #[test]
    fn what_is_no_token_is_refused() {
        let good = ShareSecret::stored("a1".repeat(32)).sign(ShareId(Uuid::from_u128(7))).expose();
        for bad in [
            "",
            &good[1..],
            &format!("{good}0"),
            &good.to_uppercase().replace('0', "G"),
            &good.replace('0', "/"),
        ] {
            assert!(bad.parse::<ShareToken>().is_err(), "{bad}");
        }
    }
}
