//! Signatures of Standard Webhooks: HMAC-SHA256 over `id.timestamp.body`.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;
use thiserror::Error;

use crate::domain::WebhookSecret;

/// The secret is malformed. The message does not contain it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("the endpoint's secret is not 'whsec_' followed by base64")]
pub struct InvalidSecretError;

/// The value of `webhook-signature`; `timestamp` is in seconds since 1970.
///
/// # Errors
/// [`InvalidSecretError`].
pub fn sign(
    secret: &WebhookSecret,
    id: &str,
    timestamp: i64,
    body: &str,
) -> Result<String, InvalidSecretError> {
    let key = secret.key().ok_or(InvalidSecretError)?;
    let mut mac = Hmac::<Sha256>::new_from_slice(&key).map_err(|_| InvalidSecretError)?;
    mac.update(format!("{id}.{timestamp}.").as_bytes());
    mac.update(body.as_bytes());
    Ok(format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_specifications_example_has_its_signature() {
        let secret = WebhookSecret::stored("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw".into());
        let id = "msg_p5jXN8AQM9LWM0D4loKWxJek";
        let signature = sign(&secret, id, 1_614_265_330, r#"{"test": 2432232314}"#);
        assert_eq!(signature.as_deref(), Ok("v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="));
        for bad in ["MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "whsec_***"] {
            let error = sign(&WebhookSecret::stored(bad.into()), id, 0, "").expect_err("no secret");
            assert!(!error.to_string().contains(bad));
        }
    }
}
