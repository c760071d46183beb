//! What messages to a webhook endpoint are signed with. It is kept in clear, since every message needs it, and never printed,
//! unless by the method whose name says so.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use secrecy::{ExposeSecret as _, SecretString};

use super::{RandomError, RandomSource};

/// What every secret begins with (Standard Webhooks).
const MARK: &str = "whsec_";
/// Random bytes of a secret; Standard Webhooks wants 24 to 64.
const RANDOM_BYTES: usize = 32;

/// A secret: `whsec_` and base64.
#[derive(Debug, Clone)]
pub struct WebhookSecret(SecretString);

impl WebhookSecret {
    /// A new secret.
    ///
    /// # Errors
    /// [`RandomError`].
    pub fn generate(entropy: &dyn RandomSource) -> Result<Self, RandomError> {
        let mut random = [0; RANDOM_BYTES];
        entropy.fill(&mut random)?;
        Ok(Self(format!("{MARK}{}", STANDARD.encode(random)).into()))
    }

    /// A secret as it was stored.
    #[must_use]
    pub fn stored(text: String) -> Self {
        Self(text.into())
    }

    /// The secret itself: for its owner, once, and for the database.
    #[must_use]
    pub fn expose(&self) -> &str {
        self.0.expose_secret()
    }

    /// The bytes that sign; none if what was stored is no secret.
    #[must_use]
    pub fn key(&self) -> Option<Vec<u8>> {
        STANDARD.decode(self.expose().strip_prefix(MARK)?).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::{super::SystemRandom, *};

    #[test]
    fn secrets_differ_sign_and_do_not_show() {
        let draw = || WebhookSecret::generate(&SystemRandom).expect("randomness");
        let (one, other) = (draw(), draw());
        assert_ne!(one.expose(), other.expose());
        assert_eq!(one.key().map(|key| key.len()), Some(RANDOM_BYTES));
        assert!(!format!("{one:?}").contains(&one.expose()[MARK.len()..]));
        for bad in ["", "whsec_***", "AAAA"] {
            assert_eq!(WebhookSecret::stored(bad.into()).key(), None, "{bad}");
        }
    }
}
