//! Addresses of buckets.

use std::{fmt, str::FromStr, sync::Arc, time::Duration};

use object_store::{
    BackoffConfig, ClientOptions, ObjectStore, RetryConfig,
    aws::{AmazonS3Builder, AmazonS3ConfigKey},
    path::Path,
    prefix::PrefixStore,
};
use rustls::crypto::ring;
use thiserror::Error;

use super::{
    BlobError,
    request_timeouts::{RequestTimeouts, TimeoutConnector},
};

/// How long a connection may take.
const CONNECT: Duration = Duration::from_secs(5);
/// How long a request is repeated.
const RETRY: Duration = Duration::from_secs(20);

/// A bucket or a prefix of one: `s3://BUCKET` or `s3://BUCKET/PREFIX`.
///
/// Region, keys and the endpoint of servers other than Amazon's come from the variables `AWS_REGION`, `AWS_ACCESS_KEY_ID`,
/// `AWS_SECRET_ACCESS_KEY`, `AWS_ENDPOINT_URL` and the others that the AWS tools read. An endpoint with `http://` is used without TLS.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BucketUrl {
    bucket: String,
    prefix: Path,
}

/// Why a text is no address of a bucket.
#[derive(Debug, Error)]
#[error("not the address of a bucket, as in s3://BUCKET or s3://BUCKET/PREFIX: {0}")]
pub struct InvalidBucketUrl(String);

impl FromStr for BucketUrl {
    type Err = InvalidBucketUrl;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let invalid = |reason: &str| InvalidBucketUrl(reason.to_owned());
        let rest = text.strip_prefix("s3://").ok_or_else(|| invalid("it does not begin with s3://"))?;
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        if bucket.contains('@') || text.contains(['?', '#']) {
            return Err(invalid("keys and options are given in AWS_ variables, not here"));
        }
        let is_name = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '.' | '-' | '_');
        if !(3..=63).contains(&bucket.len()) || !bucket.chars().all(is_name) {
            return Err(invalid("a bucket's name has 3 to 63 of a-z, 0-9, '.', '-' and '_'"));
        }
        let prefix =
            Path::parse(prefix.trim_end_matches('/')).map_err(|error| invalid(&error.to_string()))?;
        Ok(Self { bucket: bucket.to_owned(), prefix })
    }
}

impl fmt::Display for BucketUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "s3://{}", self.bucket)?;
        if self.prefix.is_root() { Ok(()) } else { write!(f, "/{}", self.prefix) }
    }
}

impl BucketUrl {
    /// Access to the bucket with the process's `AWS_` variables.
    ///
    /// # Errors
    /// [`BlobError::Bucket`] if these are not usable.
    pub fn connect(&self) -> Result<Arc<dyn ObjectStore>, BlobError> {
        self.connect_with(std::env::vars())
    }

    /// As [`BucketUrl::connect`], with these variables instead.
    ///
    /// # Errors
    /// [`BlobError::Bucket`] if these are not usable.
    pub fn connect_with(
        &self,
        variables: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Arc<dyn ObjectStore>, BlobError> {
        let mut builder = AmazonS3Builder::new();
        let mut allow_http = false;
        for (name, value) in variables {
            let Ok(key) = name.to_ascii_lowercase().parse::<AmazonS3ConfigKey>() else { continue };
            // Names without it are the library's own.
            if name.starts_with("AWS_") {
                allow_http |= key == AmazonS3ConfigKey::Endpoint && value.starts_with("http://");
                builder = builder.with_config(key, value);
            }
        }
        // Someone else's choice, if there is one, is as good.
        let _ = ring::default_provider().install_default();
        // A whole answer may take long, so only its pauses are limited, by the connector.
        let client = ClientOptions::new()
            .with_connect_timeout(CONNECT)
            .with_timeout_disabled()
            .with_allow_http(allow_http);
        let retry = RetryConfig { backoff: BackoffConfig::default(), max_retries: 6, retry_timeout: RETRY };
        let bucket = builder
            .with_bucket_name(&self.bucket)
            .with_client_options(client)
            .with_http_connector(TimeoutConnector(RequestTimeouts::default()))
            .with_retry(retry)
            .build()
            .map_err(BlobError::Bucket)?;
        Ok(if self.prefix.is_root() {
            Arc::new(bucket)
        } else {
            Arc::new(PrefixStore::new(bucket, self.prefix.clone()))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_shown() {
        for text in ["s3://scenes", "s3://my.bucket-2/tcgs", "s3://abc/a/b"] {
            assert_eq!(text.parse::<BucketUrl>().expect("an address").to_string(), text);
        }
        assert_eq!("s3://scenes/a/".parse::<BucketUrl>().expect("an address").to_string(), "s3://scenes/a");
        for (text, reason) in [
            ("scenes", "does not begin with s3://"),
            ("https://scenes.s3.amazonaws.com", "does not begin with s3://"),
            ("s3://", "3 to 63"),
            ("s3://Scenes", "3 to 63"),
            ("s3://key:secret@scenes", "AWS_ variables"),
            ("s3://scenes?region=x", "AWS_ variables"),
            ("s3://scenes/a//b", "empty"),
        ] {
            let error = text.parse::<BucketUrl>().expect_err(text).to_string();
            assert!(error.contains(reason), "{text}: {error}");
            assert!(!error.contains("secret"));
        }
    }
}
