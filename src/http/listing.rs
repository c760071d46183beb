//! Pages of what is listed newest first: the cursor between them, and how an answer points at the next.

use std::{fmt::Display, str::FromStr};

use axum::http::{HeaderMap, HeaderValue, header};
use jiff::Timestamp;

use super::problem::Fault;

/// Entries of a page that asks for no number.
pub(super) const DEFAULT_PAGE: u32 = 20;
/// Most entries of a page.
pub(super) const MAX_PAGE: u32 = 100;

/// The place after an entry, as clients carry it.
pub(super) fn cursor(created_at: Timestamp, id: impl Display) -> String {
    format!("{}.{id}", created_at.as_microsecond())
}

/// Creation and identity of the entry that a cursor stands after.
pub(super) fn parse_cursor<I: FromStr>(text: &str) -> Result<(Timestamp, I), Fault> {
    let place = text
        .split_once('.')
        .and_then(|(at, id)| Some((Timestamp::from_microsecond(at.parse().ok()?).ok()?, id.parse().ok()?)));
    place.ok_or_else(|| Fault::parameter("cursor", "is not one that this service gave out"))
}

/// Headers of a page whose next is at `next`.
pub(super) fn headers(next: Option<&str>) -> Result<HeaderMap, Fault> {
    let mut headers = HeaderMap::new();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if let Some(next) = next {
        let link = HeaderValue::try_from(format!("<{next}>; rel=\"next\""));
        headers.insert(header::LINK, link.map_err(|error| Fault::internal(&error))?);
    }
    Ok(headers)
}
