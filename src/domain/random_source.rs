//! Cryptographic randomness, from an injected [`RandomSource`], so that tests control it.

use thiserror::Error;

/// A source of unguessable bytes.
pub trait RandomSource: Send + Sync + 'static {
    /// Fills `bytes`.
    ///
    /// # Errors
    /// [`RandomError`] if the source fails.
    fn fill(&self, bytes: &mut [u8]) -> Result<(), RandomError>;
}

/// Hexadecimal digits of `N` random bytes.
///
/// # Errors
/// [`RandomError`].
pub(super) fn random_digits<const N: usize>(entropy: &dyn RandomSource) -> Result<String, RandomError> {
    let mut random = [0; N];
    entropy.fill(&mut random)?;
    Ok(hex(&random))
}

/// Bytes as hexadecimal digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The system's random number generator failed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("the system's random number generator failed: {0}")]
pub struct RandomError(pub String);

/// The operating system's generator.
#[derive(Debug, Clone, Copy, Default)]
pub struct SystemRandom;

impl RandomSource for SystemRandom {
    fn fill(&self, bytes: &mut [u8]) -> Result<(), RandomError> {
        getrandom::fill(bytes).map_err(|error| RandomError(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_system_does_not_repeat_itself() {
        let draw = || {
            let mut bytes = [0; 16];
            SystemRandom.fill(&mut bytes).expect("randomness");
            bytes
        };
        assert_ne!(draw(), draw());
    }
}
