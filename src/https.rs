//! HTTP clients with TLS by rustls and the operating system's certificates, and others where a user names them.
//!
//! The cryptography is `ring`'s and is handed over with the configuration, so nothing depends on a process having chosen one.

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

/// Why a file of certificates is none.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RootsError {
    /// Something between the marks of PEM is not what they say.
    #[error("is not PEM: {0}")]
    Pem(String),
    /// There is no certificate in it.
    #[error("holds no certificate in PEM (-----BEGIN CERTIFICATE-----)")]
    Empty,
    /// One of them cannot be trusted.
    #[error("certificate {place}: {reason}")]
    Certificate {
        /// Which one, from 1.
        place: usize,
        /// What is wrong with it.
        reason: String,
    },
}

/// Authorities that are trusted besides the operating system's: sound certificates.
#[derive(Debug, Clone, Default)]
pub struct ExtraRoots(Vec<CertificateDer<'static>>);

impl ExtraRoots {
    /// The certificates of a PEM file; whatever else is in it is passed over.
    ///
    /// # Errors
    /// [`RootsError`].
    pub fn from_pem(file: &[u8]) -> Result<Self, RootsError> {
        let certificates = CertificateDer::pem_slice_iter(file).collect::<Result<Vec<_>, _>>();
        let certificates = certificates.map_err(|fault| RootsError::Pem(fault.to_string()))?;
        if certificates.is_empty() {
            return Err(RootsError::Empty);
        }
        let mut store = RootCertStore::empty();
        for (place, certificate) in (1..).zip(&certificates) {
            store
                .add(certificate.clone())
                .map_err(|fault| RootsError::Certificate { place, reason: fault.to_string() })?;
        }
        Ok(Self(certificates))
    }
}

/// What every client begins with: this program's name, and TLS. Where the system has no certificates there is still a client,
/// and its https requests fail.
///
/// # Errors
/// If the cryptography does not offer what TLS needs.
pub fn client_builder() -> Result<reqwest::ClientBuilder, rustls::Error> {
    Ok(named(TLS.as_ref().map_err(Clone::clone)?.clone()))
}

/// The same for a client that also trusts `roots`.
///
/// # Errors
/// If the cryptography does not offer what TLS needs.
pub fn client_builder_trusting(roots: &ExtraRoots) -> Result<reqwest::ClientBuilder, rustls::Error> {
    configuration(roots).map(named)
}

/// What was wrong with the certificate of whom a request went to, if that was why it failed.
#[must_use]
pub fn certificate_fault(error: &reqwest::Error) -> Option<&'static str> {
    let mut cause: Option<&(dyn Error + 'static)> = Some(error);
    while let Some(fault) = cause {
        if let Some(rustls::Error::InvalidCertificate(fault)) = fault.downcast_ref() {
            return Some(reason(fault));
        }
        // An I/O error tells of its cause's cause as its own.
        let held = fault.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        cause = match held {
            Some(held) => Some(held),
            None => fault.source(),
        };
    }
    None
}

fn reason(fault: &CertificateError) -> &'static str {
    match fault {
        // The latter is an authority's namesake.
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
        let fault = |file: &str| ExtraRoots::from_pem(file.as_bytes()).expect_err("refused").to_string();
        for nothing in [String::new(), "hello".into(), mark("PRIVATE KEY", "AAAA")] {
            assert!(fault(&nothing).contains("no certificate"), "{nothing}");
        }
        assert!(fault(&mark("CERTIFICATE", "?")).contains("is not PEM"));
        assert!(fault(&mark("CERTIFICATE", "AAAA")).starts_with("certificate 1: "));
    }
}
