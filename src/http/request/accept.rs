//! The `Accept` header (RFC 9110 §12.5.1).

use axum::http::{HeaderMap, header};

/// Whether the `Accept` header allows `media_type`; true without one.
pub(crate) fn accepts(headers: &HeaderMap, media_type: &str) -> bool {
    weigh(headers, media_type).quality > 0.0
}

/// Whether the `Accept` header prefers `media_type` to `other`: by weight, then by specificity.
pub(crate) fn prefers(headers: &HeaderMap, media_type: &str, other: &str) -> bool {
    let (this, other) = (weigh(headers, media_type), weigh(headers, other));
    this.quality > 0.0 && this > other
}

/// The preference for a media type; ordered.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
struct Weight {
    quality: f32,
    /// How closely it was named: 3 by itself, 2 by its kind, 1 with everything, 0 not at all.
    specificity: u8,
}

fn weigh(headers: &HeaderMap, media_type: &str) -> Weight {
    let mut ranges = headers
        .get_all(header::ACCEPT)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|list| list.split(','))
        .map(str::trim)
        .filter(|range| !range.is_empty())
        .peekable();
    if ranges.peek().is_none() {
        return Weight { quality: 1.0, specificity: 0 };
    }
    let kind = media_type.split('/').next().unwrap_or_default();
    // The most specific range that matches decides.
    let mut best = Weight { quality: 0.0, specificity: 0 };
    for range in ranges {
        let mut parts = range.split(';').map(str::trim);
        let name = parts.next().unwrap_or_default().to_ascii_lowercase();
        let specificity = match name.as_str() {
            name if name == media_type => 3,
            name if name.strip_suffix("/*") == Some(kind) => 2,
            "*/*" => 1,
            _ => continue,
        };
        let weight = parts.find_map(|part| part.strip_prefix("q=").or_else(|| part.strip_prefix("Q=")));
        let quality = weight.and_then(|weight| weight.parse().ok()).filter(|weight: &f32| weight.is_finite());
        if specificity > best.specificity {
            best = Weight { quality: quality.unwrap_or(1.0), specificity };
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn the_most_specific_range_decides() {
        let accept = |value: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ACCEPT, HeaderValue::from_static(value));
            accepts(&headers, "application/json")
        };
        assert!(accepts(&HeaderMap::new(), "application/json"));
        for yes in
            ["*/*", "application/*", "text/html, application/json;q=0.1", "Application/JSON", "", "*/*;q=nan"]
        {
            assert!(accept(yes), "{yes}");
        }
        for no in
            ["text/event-stream", "text/*", "application/json;q=0", "*/*, application/json; q=0.0", "*/*;Q=0"]
        {
            assert!(!accept(no), "{no}");
        }
    }

    #[test]
    fn what_is_weighed_more_or_named_is_preferred() {
        let prefers = |value: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ACCEPT, HeaderValue::from_static(value));
            prefers(&headers, "text/event-stream", "application/json")
        };
        for yes in [
            "text/event-stream",
            "text/*",
            "text/event-stream, */*",
            "*/*, text/event-stream",
            "text/event-stream, application/json;q=0.9",
        ] {
            assert!(prefers(yes), "{yes}");
        }
        for no in [
            "",
            "*/*",
            "application/json",
            "application/json, text/event-stream",
            "application/json, text/event-stream;q=0.5",
            "application/json, */*",
            "text/event-stream;q=0",
            "image/png",
        ] {
            assert!(!prefers(no), "{no}");
        }
    }
}
