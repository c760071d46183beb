//! Figures as people read them.

/// Bytes as a count and as a rounded size, as in `152 340 (152 kB)`; below a kilobyte only the count.
pub(crate) fn bytes(count: u64) -> String {
    match count {
        0..1000 => format!("{count} B"),
        _ => format!("{} B ({})", grouped(count), size(count)),
    }
}

/// Bytes in three digits; MB is 10^6.
pub(crate) fn size(count: u64) -> String {
    let value = count as f64;
    match count {
        0..1000 => format!("{count} B"),
        1000..1_000_000 => format!("{} kB", three_digits(value / 1e3)),
        1_000_000..1_000_000_000 => format!("{} MB", three_digits(value / 1e6)),
        _ => format!("{} GB", three_digits(value / 1e9)),
    }
}

/// A count with thin gaps between thousands.
pub(crate) fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::with_capacity(digits.len() * 2);
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}

/// A time span in the two units that suit it.
pub(crate) fn duration(seconds: f64) -> String {
    let whole = seconds.max(0.0).round() as u64;
    match whole {
        0..10 => format!("{seconds:.1} s"),
        10..60 => format!("{whole} s"),
        60..3600 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole % 3600 / 60),
    }
}

/// A figure with `decimals` decimals, or a dash where there is none.
pub(crate) fn figure(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "\u{2013}".to_owned(), |value| format!("{value:.decimals$}"))
}

fn three_digits(value: f64) -> String {
    let decimals = if value >= 100.0 {
        0
    } else if value >= 10.0 {
        1
    } else {
        2
    };
    format!("{value:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times_have_the_digits_that_matter() {
        assert_eq!(size(999), "999 B");
        assert_eq!(size(1_234), "1.23 kB");
        assert_eq!(size(152_340), "152 kB");
        assert_eq!(size(45_600_000), "45.6 MB");
        assert_eq!(bytes(1_234_567), "1\u{202f}234\u{202f}567 B (1.23 MB)");
        assert_eq!(grouped(100), "100");
        assert_eq!(duration(4.25), "4.2 s");
        assert_eq!(duration(75.4), "1 min 15 s");
        assert_eq!(duration(7261.0), "2 h 1 min");
        assert_eq!(figure(None, 2), "–");
        assert_eq!(figure(Some(30.126), 2), "30.13");
    }
}
