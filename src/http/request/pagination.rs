//! Cursor pagination of lists, newest first.
//!
//! Invariant: a page ends where the next begins, whatever is added to the list in between.

use std::{fmt::Display, str::FromStr};

use axum::{
    Json,
    http::{HeaderMap, HeaderValue, header},
    response::IntoResponse as _,
};
use jiff::Timestamp;
use serde::{Serialize, Serializer, ser::SerializeMap as _};

use super::query::Parameters;
use crate::http::problem::{ApiResult, ProblemResponse};

/// Default entries per page.
const DEFAULT_PAGE: u32 = 20;
/// Most entries per page.
const MAX_PAGE: u32 = 100;

/// A requested page.
#[derive(Debug)]
pub(crate) struct Page<C> {
    limit: u32,
    /// The entry that it follows, if not the first page.
    pub(crate) after: Option<C>,
}

impl<C> Page<C> {
    /// Takes `limit`, and `cursor` as `read` understands it.
    pub(crate) fn take(parameters: &mut Parameters, read: impl FnOnce(&str) -> Option<C>) -> ApiResult<Self> {
        let limit = parameters.take_count("limit", DEFAULT_PAGE, MAX_PAGE)?;
        let after = parameters.take("cursor").map(|text| {
            read(&text)
                .ok_or_else(|| ProblemResponse::parameter("cursor", "is not one that this service gave out"))
        });
        Ok(Self { limit, after: after.transpose()? })
    }

    /// Entries to read: one more than requested shows whether there is a next page.
    pub(crate) fn to_read(&self) -> u32 {
        self.limit + 1
    }

    /// Answers with the page of what was read: its entries as `body` shows them, called `name`, and the path of the next page. `list` is
    /// the path of the list with its filters, none of which needs escaping; `cursor` gives an entry's cursor.
    pub(crate) fn answer<T, W: Display, B: Serialize>(
        &self,
        name: &'static str,
        mut entries: Vec<T>,
        list: &str,
        cursor: impl FnOnce(&T) -> W,
        body: impl FnMut(T) -> B,
    ) -> ApiResult {
        let next = self.cut(&mut entries, list, cursor);
        let mut headers = HeaderMap::new();
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
        if let Some(next) = &next {
            headers.insert(header::LINK, HeaderValue::try_from(format!("<{next}>; rel=\"next\""))?);
        }
        let entries = entries.into_iter().map(body).collect();
        Ok((headers, Json(List { name, entries, next })).into_response())
    }

    /// Truncates what was read to the page and returns the path of the next one.
    pub(crate) fn cut<T, W: Display>(
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

/// The cursor after an entry.
pub(crate) fn cursor(created_at: Timestamp, id: impl Display) -> String {
    format!("{}.{id}", created_at.as_microsecond())
}

/// Creation and identity of the entry that a cursor stands after.
pub(crate) fn parse_cursor<I: FromStr>(text: &str) -> Option<(Timestamp, I)> {
    let (at, id) = text.split_once('.')?;
    Some((Timestamp::from_microsecond(at.parse().ok()?).ok()?, id.parse().ok()?))
}

/// A page of a list as the API shows it.
struct List<B> {
    name: &'static str,
    entries: Vec<B>,
    next: Option<String>,
}

impl<B: Serialize> Serialize for List<B> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut fields = serializer.serialize_map(Some(2))?;
        fields.serialize_entry(self.name, &self.entries)?;
        fields.serialize_entry("next", &self.next)?;
        fields.end()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn page(query: &str) -> ApiResult<Page<u32>> {
        let mut parameters = Parameters::parse(Some(query))?;
        let page = Page::take(&mut parameters, |text| text.parse().ok())?;
        parameters.finish()?;
        Ok(page)
    }

    #[test]
    fn a_page_is_cut_to_its_limit_and_points_at_the_next_if_there_is_more() {
        let second = page("limit=2&cursor=7").expect("a page");
        assert_eq!((second.to_read(), second.after), (3, Some(7)));
        let mut entries = vec![9, 8, 5];
        let next = second.cut(&mut entries, "/list?old=true", |last| *last);
        assert_eq!((next.as_deref(), &*entries), (Some("/list?old=true&limit=2&cursor=8"), &[9, 8][..]));
        assert_eq!(second.cut(&mut entries, "/list", |last| *last), None, "a full page may be the last");
        assert_eq!(second.cut(&mut Vec::<u32>::new(), "/list", |last| *last), None);
        for bad in ["limit=0", "limit=101", "cursor=x"] {
            assert!(page(bad).is_err(), "{bad}");
        }
    }
}
