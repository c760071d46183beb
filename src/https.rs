//! HTTP clients with TLS by rustls and the operating system's certificates.
//!
//! The cryptography is `ring`'s and is handed over with the configuration, so nothing depends on a process having chosen one.

use std::sync::{Arc, LazyLock};

use rustls::{ClientConfig, RootCertStore, crypto::ring};
use rustls_platform_verifier::BuilderVerifierExt as _;

static TLS: LazyLock<Result<ClientConfig, rustls::Error>> = LazyLock::new(|| {
    let versions = || ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
    let with_platform = versions().with_safe_default_protocol_versions()?.with_platform_verifier();
    match with_platform {
        Ok(builder) => Ok(builder.with_no_client_auth()),
        Err(error) => {
            tracing::warn!("no certificates to trust, so every https request will fail: {error}");
            let nobody = RootCertStore::empty();
            let builder = versions().with_safe_default_protocol_versions()?;
            Ok(builder.with_root_certificates(nobody).with_no_client_auth())
        }
    }
});

/// What every client begins with: this program's name, and TLS. Where the system has no certificates there is still a client,
/// and its https requests fail.
///
/// # Errors
/// If the cryptography does not offer what TLS needs.
pub fn client_builder() -> Result<reqwest::ClientBuilder, rustls::Error> {
    let tls = TLS.as_ref().map_err(Clone::clone)?.clone();
    let name = concat!(env!("CARGO_PKG_NAME"), "/", env!("CARGO_PKG_VERSION"));
    Ok(reqwest::Client::builder().user_agent(name).tls_backend_preconfigured(tls))
}

#[cfg(test)]
mod tests {
    #[test]
    fn there_is_a_client_on_every_machine() {
        super::client_builder().expect("TLS").build().expect("a client");
    }
}
