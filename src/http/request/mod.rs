//! What requests are made of, read the same way by every handler: bodies, query parameters, headers, conditions and pages.

mod accept;
mod body;
pub(super) mod content_digest;
mod etag;
pub(super) mod idempotency;
mod pagination;
pub(super) mod prefer;
mod query;
mod range;

pub(super) use accept::{accepts, prefers};
pub(super) use body::{
    ApiJson, JsonBody, Pieces, announced_length, expect_media_type, expect_no_coding, media_type, parse_json,
    present, read_json, read_optional_json, whole_numbers,
};
pub(super) use etag::{Etag, IfMatch, not_modified};
pub(super) use idempotency::{CreateOutcome, CreateRequest, Resource, idempotent};
pub(super) use pagination::{Page, cursor, parse_cursor};
pub(super) use query::Parameters;
pub(super) use range::{ByteRange, parse_range};
