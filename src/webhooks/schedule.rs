//! What follows an attempt. Pure: times come in and go out as values.

use std::time::Duration;

use jiff::{Timestamp, fmt::rfc2822};

use super::send::{Answered, SendError};
use crate::{
    domain::{DeliveryId, Digest},
    store::{AfterAttempt, DeliveryResult, DueDelivery},
};

const MINUTE: u64 = 60;
const HOUR: u64 = 60 * MINUTE;
/// Seconds from each attempt that failed to the next; the first is made at once (Standard Webhooks).
const PAUSES: [u64; 9] =
    [5, 5 * MINUTE, 30 * MINUTE, 2 * HOUR, 5 * HOUR, 10 * HOUR, 14 * HOUR, 20 * HOUR, 24 * HOUR];
/// Longest pause that an endpoint may ask for.
const LONGEST: Duration = Duration::from_secs(24 * HOUR);

/// What an attempt came to and what follows.
pub(super) fn settle(due: &DueDelivery, sent: Result<Answered, SendError>) -> DeliveryResult {
    let (status, asked, fault) = match sent {
        Ok(answer) => (Some(answer.status), answer.retry_after, fault(answer.status)),
        Err(error) => (None, None, Some(error.to_string())),
    };
    let next = match (status, &fault) {
        (_, None) => AfterAttempt::Done,
        (Some(410), _) => AfterAttempt::DisableEndpoint,
        _ => again(due, asked.as_deref()),
    };
    DeliveryResult { status, fault, next }
}

fn fault(status: u16) -> Option<String> {
    match status {
        200..=299 => None,
        300..=399 => Some(format!("the endpoint answered {status}; redirections are not followed")),
        410 => Some("the endpoint answered 410; it is told nothing more".into()),
        _ => Some(format!("the endpoint answered {status}")),
    }
}

fn again(due: &DueDelivery, asked: Option<&str>) -> AfterAttempt {
    let place = usize::try_from(due.tries.saturating_sub(1)).unwrap_or(usize::MAX);
    let Some(seconds) = PAUSES.get(place) else { return AfterAttempt::GiveUp };
    let pause = Duration::from_secs(*seconds).mul_f64(spread(due.id, due.tries));
    let asked = asked.and_then(|text| retry_after(text, due.at)).unwrap_or_default();
    AfterAttempt::RetryAfter(pause.max(asked.min(LONGEST)))
}

/// A factor in [0.9, 1.1] that the delivery and the try decide, so that endpoints which failed together are not asked together.
fn spread(id: DeliveryId, tries: u32) -> f64 {
    let draw = Digest::of(format!("{id}/{tries}").as_bytes()).as_bytes()[0];
    0.9 + 0.2 * f64::from(draw) / 255.0
}

/// `Retry-After` in either of its forms: seconds, or an instant.
fn retry_after(text: &str, now: Timestamp) -> Option<Duration> {
    let text = text.trim();
    if let Ok(seconds) = text.parse() {
        return Some(Duration::from_secs(seconds));
    }
    let at = rfc2822::DateTimeParser::new().parse_timestamp(text).ok()?;
    Duration::try_from(at.duration_since(now)).ok()
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::domain::WebhookSecret;

    fn due(tries: u32) -> DueDelivery {
        DueDelivery {
            id: DeliveryId(Uuid::from_u128(7)),
            attempt: tries,
            tries,
            url: "https://example.com/".into(),
            secret: WebhookSecret::stored("whsec_".into()),
            body: String::new(),
            at: "2026-11-21T12:00:00Z".parse().expect("an instant"),
        }
    }

    fn answered(status: u16, retry_after: Option<&str>) -> Result<Answered, SendError> {
        Ok(Answered { status, retry_after: retry_after.map(str::to_owned) })
    }

    #[test]
    fn attempts_that_fail_are_made_again_ten_times_in_all() {
        for (tries, seconds) in (1..).zip(PAUSES) {
            let AfterAttempt::RetryAfter(pause) = settle(&due(tries), answered(500, None)).next else {
                panic!("try {tries} is the last");
            };
            let ratio = pause.as_secs_f64() / seconds as f64;
            assert!((0.9..=1.1).contains(&ratio), "try {tries}: {pause:?}");
        }
        assert_eq!(settle(&due(10), answered(500, None)).next, AfterAttempt::GiveUp);
        assert_eq!(settle(&due(10), Err(SendError::Timeout(15))).next, AfterAttempt::GiveUp);
    }

    #[test]
    fn only_2xx_is_success_and_410_is_the_end() {
        for status in [200, 202, 204, 299] {
            let settled = settle(&due(1), answered(status, None));
            assert_eq!((settled.next, settled.fault), (AfterAttempt::Done, None));
        }
        assert_eq!(settle(&due(1), answered(410, None)).next, AfterAttempt::DisableEndpoint);
        for status in [100, 301, 302, 307, 400, 404, 429, 500, 502] {
            let settled = settle(&due(1), answered(status, None));
            assert!(matches!(settled.next, AfterAttempt::RetryAfter(_)), "{status}");
            assert!(settled.fault.is_some_and(|fault| fault.contains(&status.to_string())));
        }
    }

    #[test]
    fn an_endpoint_may_ask_for_a_longer_pause_and_not_for_a_shorter_one() {
        let pause = |tries, asked| match settle(&due(tries), answered(503, Some(asked))).next {
            AfterAttempt::RetryAfter(pause) => pause.as_secs(),
            other => panic!("{other:?}"),
        };
        assert_eq!(pause(1, "120"), 120);
        assert_eq!(pause(1, "Sat, 21 Nov 2026 13:00:00 GMT"), 3600);
        assert_eq!(pause(1, "99999999999"), 24 * HOUR);
        for short in ["0", "Sat, 21 Nov 2026 11:00:00 GMT", "soon", "-5", ""] {
            assert!((4..=6).contains(&pause(1, short)), "{short}");
        }
        assert!(pause(2, "1") >= 4 * MINUTE);
    }
}
