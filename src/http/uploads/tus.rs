//! The headers of the tus protocol 1.0.0 (resumable uploads).

use std::collections::BTreeSet;

use axum::{
    http::{HeaderMap, HeaderName, HeaderValue, header},
    response::Response,
};
use base64::{Engine as _, engine::general_purpose::STANDARD};
use jiff::{Timestamp, fmt::rfc2822::DateTimePrinter};
use sha1::Sha1;
use sha2::{Digest as _, Sha256};

use crate::{
    domain::ProblemType,
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::expect_media_type,
    },
};

/// The supported version.
pub(super) const VERSION: HeaderValue = HeaderValue::from_static("1.0.0");
/// The supported extensions.
pub(super) const EXTENSIONS: HeaderValue =
    HeaderValue::from_static("creation,expiration,checksum,termination");
/// The supported checksum algorithms.
pub(super) const ALGORITHMS: HeaderValue = HeaderValue::from_static("sha256,sha1");

pub(super) const RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
pub(super) const TUS_VERSION: HeaderName = HeaderName::from_static("tus-version");
pub(super) const EXTENSION: HeaderName = HeaderName::from_static("tus-extension");
pub(super) const MAX_SIZE: HeaderName = HeaderName::from_static("tus-max-size");
pub(super) const CHECKSUM_ALGORITHM: HeaderName = HeaderName::from_static("tus-checksum-algorithm");
pub(super) const LENGTH: HeaderName = HeaderName::from_static("upload-length");
pub(super) const OFFSET: HeaderName = HeaderName::from_static("upload-offset");
pub(super) const METADATA: HeaderName = HeaderName::from_static("upload-metadata");
pub(super) const EXPIRES: HeaderName = HeaderName::from_static("upload-expires");
pub(super) const METHOD_OVERRIDE: HeaderName = HeaderName::from_static("x-http-method-override");
const DEFER_LENGTH: HeaderName = HeaderName::from_static("upload-defer-length");
const CHECKSUM: HeaderName = HeaderName::from_static("upload-checksum");

/// Media type of a part.
const PART: &str = "application/offset+octet-stream";

/// Longest `Upload-Metadata`.
const MAX_METADATA: usize = 4096;

/// Adds the protocol version to every response.
pub(crate) async fn stamp(mut response: Response) -> Response {
    response.headers_mut().insert(RESUMABLE, VERSION);
    response
}

/// 412 unless the request speaks this version.
pub(crate) fn expect_version(headers: &HeaderMap) -> ApiResult<()> {
    if headers.get(RESUMABLE) == Some(&VERSION) {
        return Ok(());
    }
    Err(ProblemType::TusVersion
        .because("this is an upload in the tus protocol 1.0.0: send Tus-Resumable: 1.0.0")
        .with_header(TUS_VERSION, VERSION))
}

/// 400 about one header.
fn bad_header(name: &HeaderName, error: impl std::fmt::Display) -> ProblemResponse {
    ProblemType::InvalidHeader.because(format!("{name}: {error}"))
}

/// A count of bytes: decimal digits and nothing else.
fn count(headers: &HeaderMap, name: &HeaderName) -> ApiResult<u64> {
    let value = headers.get(name).ok_or_else(|| bad_header(name, "is missing"))?;
    let digits = value.to_str().ok().filter(|text| text.bytes().all(|byte| byte.is_ascii_digit()));
    digits
        .and_then(|digits| digits.parse().ok())
        .ok_or_else(|| bad_header(name, "is not a whole number of bytes"))
}

/// What `POST /v1/uploads` says of an upload.
#[derive(Debug)]
pub(crate) struct CreateUploadRequest {
    pub(crate) length: u64,
    pub(crate) metadata: Option<Metadata>,
}

impl CreateUploadRequest {
    /// Reads the headers that follow `Tus-Resumable`.
    pub(crate) fn of(headers: &HeaderMap) -> ApiResult<Self> {
        if headers.contains_key(DEFER_LENGTH) {
            return Err(bad_header(&DEFER_LENGTH, "is not possible here; give Upload-Length"));
        }
        if has_body(headers) {
            return Err(bad_header(&header::CONTENT_LENGTH, "is not 0; bytes are sent with PATCH"));
        }
        Ok(Self { length: count(headers, &LENGTH)?, metadata: Metadata::of(headers)? })
    }
}

/// What `PATCH /v1/uploads/{id}` says of a part.
#[derive(Debug)]
pub(crate) struct AppendPartRequest {
    pub(crate) offset: u64,
    pub(crate) checksum: Option<Checksum>,
}

impl AppendPartRequest {
    /// Reads the headers that follow `Tus-Resumable`.
    pub(crate) fn of(headers: &HeaderMap) -> ApiResult<Self> {
        expect_media_type(headers, &[PART])?;
        Ok(Self { offset: count(headers, &OFFSET)?, checksum: Checksum::of(headers)? })
    }
}

/// The client's metadata of an upload: names with values, untrusted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Metadata {
    text: String,
    pairs: Vec<(String, Vec<u8>)>,
}

impl Metadata {
    /// Reads `Upload-Metadata`, if it is there and not empty.
    pub(crate) fn of(headers: &HeaderMap) -> ApiResult<Option<Self>> {
        let Some(value) = headers.get(METADATA) else { return Ok(None) };
        let text = value.to_str().ok().filter(|text| text.len() <= MAX_METADATA);
        let text = text
            .ok_or_else(|| bad_header(&METADATA, format!("is not ASCII of at most {MAX_METADATA} bytes")))?;
        if text.trim().is_empty() {
            return Ok(None);
        }
        Self::parse(text).map(Some).map_err(|error| bad_header(&METADATA, error))
    }

    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let mut pairs = Vec::new();
        let mut names = BTreeSet::new();
        for pair in text.split(',').map(str::trim) {
            let (name, value) = pair.split_once(' ').unwrap_or((pair, ""));
            if name.is_empty() {
                return Err("a name is empty".into());
            }
            if !names.insert(name) {
                return Err(format!("'{name}' is given twice"));
            }
            let value = STANDARD.decode(value).map_err(|_| format!("the value of '{name}' is not base64"))?;
            pairs.push((name.to_owned(), value));
        }
        Ok(Self { text: text.to_owned(), pairs })
    }

    /// As it was sent.
    pub(crate) fn into_text(self) -> String {
        self.text
    }

    /// The text of one name.
    pub(crate) fn get(&self, name: &str) -> Option<&str> {
        let (_, value) = self.pairs.iter().find(|(given, _)| given == name)?;
        std::str::from_utf8(value).ok()
    }
}

/// The running checksum of a part, and the announced one.
#[derive(Debug)]
pub(crate) struct Checksum {
    hasher: Hasher,
    announced: Vec<u8>,
}

#[derive(Debug, Clone)]
enum Hasher {
    Sha256(Sha256),
    Sha1(Sha1),
}

impl Checksum {
    /// Reads `Upload-Checksum`, if it is there.
    pub(crate) fn of(headers: &HeaderMap) -> ApiResult<Option<Self>> {
        let Some(value) = headers.get(CHECKSUM) else { return Ok(None) };
        let bad = |error: &str| bad_header(&CHECKSUM, error);
        let (algorithm, sum) = value
            .to_str()
            .ok()
            .and_then(|text| text.trim().split_once(' '))
            .ok_or_else(|| bad("is not an algorithm and a sum in base64"))?;
        let (hasher, length) = match algorithm {
            "sha256" => (Hasher::Sha256(Sha256::new()), 32),
            "sha1" => (Hasher::Sha1(Sha1::new()), 20),
            _ => return Err(bad("has an algorithm other than sha256 and sha1")),
        };
        let announced = STANDARD.decode(sum).ok().filter(|sum| sum.len() == length);
        let announced = announced.ok_or_else(|| bad("has a sum that is not base64 of the right length"))?;
        Ok(Some(Self { hasher, announced }))
    }

    pub(crate) fn update(&mut self, piece: &[u8]) {
        match &mut self.hasher {
            Hasher::Sha256(hasher) => hasher.update(piece),
            Hasher::Sha1(hasher) => hasher.update(piece),
        }
    }

    /// Whether the checksum is the announced one.
    pub(crate) fn matches(&self) -> bool {
        match self.hasher.clone() {
            Hasher::Sha256(hasher) => hasher.finalize().as_slice() == self.announced,
            Hasher::Sha1(hasher) => hasher.finalize().as_slice() == self.announced,
        }
    }
}

/// An instant as `Upload-Expires` has it (RFC 9110 §5.6.7).
pub(super) fn date(at: Timestamp) -> ApiResult<HeaderValue> {
    let text = DateTimePrinter::new().timestamp_to_rfc9110_string(&at);
    let text = text.map_err(|error| ProblemResponse::internal(&error))?;
    Ok(HeaderValue::try_from(text)?)
}

/// Whether a request to create an upload has a body, which is an extension that is not supported.
fn has_body(headers: &HeaderMap) -> bool {
    headers.contains_key(header::TRANSFER_ENCODING)
        || headers.get(header::CONTENT_LENGTH).is_some_and(|length| length.as_bytes() != b"0")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn with(name: HeaderName, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name, HeaderValue::from_str(value).expect("a value"))])
    }

    #[test]
    fn only_plain_digits_are_a_count() {
        assert_eq!(count(&with(OFFSET, "0"), &OFFSET).expect("a count"), 0);
        assert_eq!(count(&with(OFFSET, &u64::MAX.to_string()), &OFFSET).expect("a count"), u64::MAX);
        for bad in ["", "-1", "+1", " 1", "1.0", "0x10", "1e3", "18446744073709551616", "1 2"] {
            count(&with(OFFSET, bad), &OFFSET).expect_err(bad);
        }
        count(&HeaderMap::new(), &OFFSET).expect_err("missing");
    }

    #[test]
    fn metadata_is_names_with_values_in_base64() {
        let metadata =
            Metadata::parse("filename Z2FyZGVuLnppcA==,is_private, name R2FyZGVu").expect("metadata");
        assert_eq!(metadata.get("filename"), Some("garden.zip"));
        assert_eq!(metadata.get("is_private"), Some(""));
        assert_eq!((metadata.get("name"), metadata.get("other")), (Some("Garden"), None));
        for bad in ["a,", ",", "a YQ==,a YQ==", "a Y", "a YQ== YQ==", " ,a"] {
            Metadata::parse(bad).expect_err(bad);
        }
        assert_eq!(Metadata::of(&with(METADATA, " ")).expect("nothing"), None);
        Metadata::of(&with(METADATA, &"a".repeat(MAX_METADATA))).expect("just short enough");
        Metadata::of(&with(METADATA, &"a".repeat(MAX_METADATA + 1))).expect_err("too long");
    }

    #[test]
    fn an_upload_is_begun_without_a_body() {
        assert!(!has_body(&HeaderMap::new()) && !has_body(&with(header::CONTENT_LENGTH, "0")));
        assert!(has_body(&with(header::CONTENT_LENGTH, "5")));
        assert!(has_body(&with(header::TRANSFER_ENCODING, "chunked")));
    }

    #[test]
    fn sums_are_of_a_known_algorithm_and_its_length() {
        for (sum, good) in [
            ("sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=", true),
            ("sha1 qZk+NkcGgWq6PiVxeFDCbJzQ2J0=", false),
            ("sha256 uU0nuZNNPgilLlLX2n2r+sSE7+N6U4DukIj3rOLvzek=", true),
        ] {
            let mut checksum = Checksum::of(&with(CHECKSUM, sum)).expect("a sum").expect("given");
            checksum.update(b"hello ");
            checksum.update(b"world");
            assert_eq!(checksum.matches(), good, "{sum}");
        }
        for bad in
            ["", "sha1", "md5 XrY7u+Ae7tCTyyK7j1rNww==", "sha1 !", "sha256 Kq5sNclPz7QV2+lfQIuc6R7oRu0="]
        {
            Checksum::of(&with(CHECKSUM, bad)).expect_err(bad);
        }
    }

    #[test]
    fn instants_are_dates_of_http() {
        let at = "2026-11-21T12:34:56.789Z".parse().expect("an instant");
        assert_eq!(date(at).expect("a date"), "Sat, 21 Nov 2026 12:34:56 GMT");
    }

    proptest! {
        #[test]
        fn any_header_is_read_or_refused_and_metadata_reads_back(text in "[ -~]{0,80}", value in ".{0,20}") {
            let headers = with(METADATA, text.trim());
            if let Ok(Some(metadata)) = Metadata::of(&headers) {
                prop_assert_eq!(Metadata::parse(&metadata.text).expect("read before"), metadata);
            }
            let _ = Checksum::of(&with(CHECKSUM, text.trim()));
            let _ = count(&with(OFFSET, text.trim()), &OFFSET);
            let sent = format!("name {}", STANDARD.encode(&value));
            let metadata = Metadata::parse(&sent).expect("well-formed");
            prop_assert_eq!(metadata.get("name"), Some(&*value));
        }
    }
}
