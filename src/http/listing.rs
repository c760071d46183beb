//! Pages of what is listed newest first: how one is asked for, and how its answer points at the next.
//!
//! What always holds: a page ends where the next begins, whatever is added to the list between the two.

use std::{fmt::Display, str::FromStr};

use axum::http::{HeaderMap, HeaderValue, header};
use jiff::Timestamp;

use super::{problem::Fault, query::Parameters};

/// Entries of a page that asks for no number.
const DEFAULT_PAGE: u32 = 20;
/// Most entries of a page.
const MAX_PAGE: u32 = 100;

/// A page as it is asked for: of what follows an entry, if one is named.
#[derive(Debug)]
pub(super) struct Page<C> {
    limit: u32,
    /// The entry.
    pub(super) after: Option<C>,
}

impl<C> Page<C> {
    /// Takes `limit`, and `cursor` as `read` understands it.
    pub(super) fn take(
        parameters: &mut Parameters,
        read: impl FnOnce(&str) -> Option<C>,
    ) -> Result<Self, Fault> {
        let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
        let after = parameters.take("cursor").map(|text| {
            read(&text).ok_or_else(|| Fault::parameter("cursor", "is not one that this service gave out"))
        });
        Ok(Self { limit, after: after.transpose()? })
    }

    /// Entries to read: one more than asked for tells whether there is a next page.
    pub(super) fn to_read(&self) -> u32 {
        self.limit + 1
    }

    /// Leaves what was asked for of what was read, and gives the path of the page after it. `list` is the path of the list with
    /// whatever else chose the entries, none of which needs escaping; `cursor` that of an entry.
    pub(super) fn cut<T, W: Display>(
        &self,
        entries: &mut Vec<T>,
        list: &str,
        cursor: impl FnOnce(&T) -> W,
    ) -> Option<String> {
        let more = entries.len() > self.limit as usize;
        entries.truncate(self.limit as usize);
        let last = entries.last().filter(|_| more)?;
        let join = if list.contains('?') { '&' } else { '?' };
        Some(format!("{list}{join}limit={}&cursor={}", self.limit, cursor(last)))
    }
}

/// The place after an entry, as clients carry it.
pub(super) fn cursor(created_at: Timestamp, id: impl Display) -> String {
    format!("{}.{id}", created_at.as_microsecond())
}

/// Creation and identity of the entry that a cursor stands after.
pub(super) fn parse_cursor<I: FromStr>(text: &str) -> Option<(Timestamp, I)> {
    let (at, id) = text.split_once('.')?;
    Some((Timestamp::from_microsecond(at.parse().ok()?).ok()?, id.parse().ok()?))
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

#[cfg(test)]
mod tests {
    use super::*;

    fn page(query: &str) -> Result<Page<u32>, Fault> {
        let mut parameters = Parameters::parse(Some(query))?;
        let page = Page::take(&mut parameters, |text| text.parse().ok())?;
        parameters.finish()?;
        Ok(page)
    }

    #[test]
    fn a_page_is_cut_to_its_limit_and_points_at_the_next_if_there_is_more() {
        let asked = page("limit=2&cursor=7").expect("a page");
        assert_eq!((asked.to_read(), asked.after), (3, Some(7)));
        let mut entries = vec![9, 8, 5];
        let next = asked.cut(&mut entries, "/list?old=true", |last| *last);
        assert_eq!((next.as_deref(), &*entries), (Some("/list?old=true&limit=2&cursor=8"), &[9, 8][..]));
        assert_eq!(asked.cut(&mut entries, "/list", |last| *last), None, "a full page may be the last");
        assert_eq!(asked.cut(&mut Vec::<u32>::new(), "/list", |last| *last), None);
        for bad in ["limit=0", "limit=101", "cursor=x"] {
            assert!(page(bad).is_err(), "{bad}");
        }
    }
}
