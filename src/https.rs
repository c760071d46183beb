//! Builds HTTPS clients: rustls with the operating system's root certificates, plus those that a user names.
//!
//! `ring` is set as the provider in each configuration, so that no process-wide default provider is needed.

use std::{
    error::Error,
    io,
    sync::{Arc, LazyLock},
};

use rustls::{
    CertificateError, ClientConfig, RootCertStore,
    client::danger::ServerCertVerifier,
    crypto::ring,
    pki_types::{CertificateDer, pem::PemObject as _},
};
use rustls_platform_verifier::Verifier;
use thiserror::Error;

static TLS: LazyLock<Result<ClientConfig, rustls::Error>> =
    LazyLock::new(|| configuration(&ExtraRoots::default()));

/// Why a file of root certificates is refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RootsError {
    /// A PEM block does not decode.
    #[error("is not PEM: {0}")]
    Pem(String),
    /// The file has no certificate.
    #[error("holds no certificate in PEM (-----BEGIN CERTIFICATE-----)")]
    Empty,
    /// A certificate cannot serve as a trust anchor.
    #[error("certificate {place}: {reason}")]
    Certificate {
        /// Its place in the file, from 1.
        place: usize,
        /// What is wrong with it.
        reason: String,
    },
}

/// Root certificates that are trusted besides the operating system's, each one checked.
#[derive(Debug, Clone, Default)]
pub struct ExtraRoots(Vec<CertificateDer<'static>>);

impl ExtraRoots {
    /// Reads the certificates of a PEM file and ignores its other blocks.
    ///
    /// # Errors
    /// [`RootsError`].
    pub fn from_pem(file: &[u8]) -> Result<Self, RootsError> {
        let certificates = CertificateDer::pem_slice_iter(file).collect::<Result<Vec<_>, _>>();
        let certificates = certificates.map_err(|error| RootsError::Pem(error.to_string()))?;
        if certificates.is_empty() {
            return Err(RootsError::Empty);
        }
        let mut store = RootCertStore::empty();
        for (place, certificate) in (1..).zip(&certificates) {
            store
                .add(certificate.clone())
                .map_err(|error| RootsError::Certificate { place, reason: error.to_string() })?;
        }
        Ok(Self(certificates))
    }
}

/// A client builder with this program's user agent and TLS. On a system without root certificates it still builds a client,
/// whose https requests fail.
///
/// # Errors
/// If `ring` lacks a protocol version that rustls needs.
pub fn client_builder() -> Result<reqwest::ClientBuilder, rustls::Error> {
    Ok(named(TLS.as_ref().map_err(Clone::clone)?.clone()))
}

/// As [`client_builder`], for a client that also trusts `roots`.
///
/// # Errors
/// If `ring` lacks a protocol version that rustls needs.
pub fn client_builder_trusting(roots: &ExtraRoots) -> Result<reqwest::ClientBuilder, rustls::Error> {
    configuration(roots).map(named)
}

/// What was wrong with the server's certificate, if that is why the request failed.
#[must_use]
pub fn certificate_error(error: &reqwest::Error) -> Option<&'static str> {
    let mut cause: Option<&(dyn Error + 'static)> = Some(error);
    while let Some(error) = cause {
        if let Some(rustls::Error::InvalidCertificate(error)) = error.downcast_ref() {
            return Some(reason(error));
        }
        // `io::Error::source` skips the error that it wraps.
        let held = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        cause = match held {
            Some(held) => Some(held),
            None => error.source(),
        };
    }
    None
}

fn reason(error: &CertificateError) -> &'static str {
    match error {
        // A bad signature means another authority of the same name.
        CertificateError::UnknownIssuer | CertificateError::BadSignature => {
            "is signed by no authority that is trusted here"
        }
        CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
            "is for another name"
        }
        CertificateError::Expired | CertificateError::ExpiredContext { .. } => "has expired",
        CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => "is not valid yet",
        CertificateError::Revoked => "is revoked",
        _ => "is not valid",
    }
}

fn named(tls: ClientConfig) -> reqwest::ClientBuilder {
    let name = concat!(env!("CARGO_PKG_NAME"), "/", env!("CARGO_PKG_VERSION"));
    reqwest::Client::builder().user_agent(name).tls_backend_preconfigured(tls)
}

fn configuration(roots: &ExtraRoots) -> Result<ClientConfig, rustls::Error> {
    let provider = Arc::new(ring::default_provider());
    let builder =
        ClientConfig::builder_with_provider(Arc::clone(&provider)).with_safe_default_protocol_versions()?;
    let builder = match Verifier::new_with_extra_roots(roots.0.iter().cloned(), provider) {
        Ok(verifier) => {
            let verifier: Arc<dyn ServerCertVerifier> = Arc::new(verifier);
            builder.dangerous().with_custom_certificate_verifier(verifier)
        }
        Err(error) => {
            tracing::warn!("no certificates to trust, so every https request will fail: {error}");
            builder.with_root_certificates(RootCertStore::empty())
        }
    };
    Ok(builder.with_no_client_auth())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_is_a_client_on_every_machine() {
        client_builder().expect("TLS").build().expect("a client");
        client_builder_trusting(&ExtraRoots::default()).expect("TLS").build().expect("a client");
    }

    #[test]
    fn a_file_that_holds_no_certificate_is_refused_with_what_is_wrong() {
        let mark = |kind: &str, text: &str| format!("-----BEGIN {kind}-----\n{text}\n-----END {kind}-----\n");
        let error = |file: &str| ExtraRoots::from_pem(file.as_bytes()).expect_err("refused").to_string();
        for nothing in [String::new(), "hello".into(), mark("PRIVATE KEY", "AAAA")] {
            assert!(error(&nothing).contains("no certificate"), "{nothing}");
        }
        assert!(error(&mark("CERTIFICATE", "?")).contains("is not PEM"));
        assert!(error(&mark("CERTIFICATE", "AAAA")).starts_with("certificate 1: "));
    }
}
