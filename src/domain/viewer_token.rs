//! What a viewer process expects of whoever asks it for pictures. It is kept in clear in the database, where only processes of the same
//! service can read it, and never printed, unless by the method whose name says so.

use secrecy::{ExposeSecret as _, SecretString};
use subtle::ConstantTimeEq as _;

use super::{RandomError, RandomSource, random_source::random_digits};

/// Random bytes of a token.
const RANDOM_BYTES: usize = 32;

/// A token: hexadecimal digits.
#[derive(Debug, Clone)]
pub struct ViewerToken(SecretString);

impl ViewerToken {
    /// A new token.
    ///
    /// # Errors
    /// [`RandomError`].
    pub fn generate(entropy: &dyn RandomSource) -> Result<Self, RandomError> {
        Ok(Self(random_digits::<RANDOM_BYTES>(entropy)?.into()))
    }

    /// A token as it was stored.
    #[must_use]
    pub fn stored(text: String) -> Self {
        Self(text.into())
    }

    /// The token itself: for the database, and for requests to its viewer.
    #[must_use]
    pub fn expose(&self) -> &str {
        self.0.expose_secret()
    }

    /// Whether a request has sent this token; the time does not depend on where they differ.
    #[must_use]
    pub fn matches(&self, sent: &str) -> bool {
        bool::from(self.expose().as_bytes().ct_eq(sent.as_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use super::{super::SystemRandom, *};

    #[test]
    fn tokens_differ_match_themselves_and_do_not_show() {
        let draw = || ViewerToken::generate(&SystemRandom).expect("randomness");
        let (one, other) = (draw(), draw());
        assert!(
            one.matches(one.expose()) && ViewerToken::stored(one.expose().to_owned()).matches(one.expose())
        );
        for wrong in [other.expose(), "", &one.expose()[1..]] {
            assert!(!one.matches(wrong));
        }
        assert!(!format!("{one:?}").contains(one.expose()));
    }
}
