//! Single byte ranges (RFC 9110 §14).

use std::ops::Range;

/// What a `Range` header asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ByteRange {
    /// Everything: there is no range, or none that this server honors (several ranges, another unit).
    Whole,
    /// A part that is not empty.
    Part(Range<u64>),
    /// A part beyond the end.
    Unsatisfiable,
}

/// Reads a `Range` header for a representation of `length` bytes.
pub(crate) fn parse_range(header: Option<&str>, length: u64) -> ByteRange {
    let Some(spec) = header.and_then(|header| header.trim().strip_prefix("bytes=")) else {
        return ByteRange::Whole;
    };
    if spec.contains(',') {
        return ByteRange::Whole;
    }
    let Some((first, last)) = spec.trim().split_once('-') else { return ByteRange::Whole };
    let number = |text: &str| {
        let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        // A number beyond 64 bits is still a number: it lies past every end.
        digits.then(|| text.parse().unwrap_or(u64::MAX))
    };
    let range = match (first.is_empty(), number(first), last.is_empty(), number(last)) {
        (true, _, _, Some(suffix)) => length.saturating_sub(suffix)..length,
        (_, Some(first), true, _) => first..length,
        (_, Some(first), _, Some(last)) if first <= last => first..last.saturating_add(1).min(length),
        _ => return ByteRange::Whole,
    };
    if range.start < range.end { ByteRange::Part(range) } else { ByteRange::Unsatisfiable }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_standard_s_examples() {
        for (header, expected) in [
            ("bytes=0-499", ByteRange::Part(0..500)),
            ("bytes=7-7", ByteRange::Part(7..8)),
            ("bytes=9500-", ByteRange::Part(9500..10000)),
            ("bytes=-500", ByteRange::Part(9500..10000)),
            ("bytes=-20000", ByteRange::Part(0..10000)),
            ("bytes=9999-99999999999999999999999", ByteRange::Part(9999..10000)),
            ("bytes=10000-", ByteRange::Unsatisfiable),
            ("bytes=-0", ByteRange::Unsatisfiable),
            ("bytes=0-0,-1", ByteRange::Whole),
            ("bytes=5-4", ByteRange::Whole),
            ("bytes=a-b", ByteRange::Whole),
            ("bytes=+1-2", ByteRange::Whole),
            ("items=0-1", ByteRange::Whole),
        ] {
            assert_eq!(parse_range(Some(header), 10000), expected, "{header}");
        }
        assert_eq!(parse_range(None, 10), ByteRange::Whole);
        assert_eq!(parse_range(Some("bytes=0-"), 0), ByteRange::Unsatisfiable);
    }

    proptest! {
        #[test]
        fn a_part_lies_within_the_whole(header in "bytes=[0-9]{0,22}-[0-9]{0,22}", length in 0_u64..1000) {
            if let ByteRange::Part(range) = parse_range(Some(&header), length) {
                prop_assert!(range.start < range.end && range.end <= length);
            }
        }
    }
}
