//! Decides what follows an attempt. Pure functions: times come in and go out as values.

use std::time::Duration;

use jiff::{Timestamp, fmt::rfc2822};

use super::send::{Response, SendError};
use crate::{
    domain::{DeliveryId, Digest},
    store::{AfterAttempt, DeliveryResult, DueDelivery},
};

const MINUTE: u64 = 60;
const HOUR: u64 = 60 * MINUTE;
/// Seconds from each failed attempt to the next; the first is made at once (Standard Webhooks).
const PAUSES: [u64; 9] =
    [5, 5 * MINUTE, 30 * MINUTE, 2 * HOUR, 5 * HOUR, 10 * HOUR, 14 * HOUR, 20 * HOUR, 24 * HOUR];
/// Longest pause that an endpoint may request.
const MAX_RETRY_AFTER: Duration = Duration::from_secs(24 * HOUR);

/// The result of an attempt, with what follows.
pub(super) fn result_of(due: &DueDelivery, sent: Result<Response, SendError>) -> DeliveryResult {
    let (response_status, retry_after, error) = match sent {
        Ok(response) => (Some(response.status), response.retry_after, error_of(response.status)),
        Err(error) => (None, None, Some(error.to_string())),
    };
    let next = match (response_status, &error) {
        (_, None) => AfterAttempt::Done,
        (Some(410), _) => AfterAttempt::DisableEndpoint,
        _ => retry(due, retry_after.as_deref()),
    };
    DeliveryResult { response_status, error, next }
}

fn error_of(status: u16) -> Option<String> {
    match status {
        200..=299 => None,
        300..=399 => Some(format!("the endpoint responded {status}; redirections are not followed")),
        410 => Some("the endpoint responded 410; it gets no more messages".into()),
        _ => Some(format!("the endpoint responded {status}")),
    }
}

fn retry(due: &DueDelivery, retry_after: Option<&str>) -> AfterAttempt {
    let Some(seconds) = PAUSES.get(due.tries.saturating_sub(1) as usize) else { return AfterAttempt::GiveUp };
    let pause = Duration::from_secs(*seconds).mul_f64(jitter(due.id, due.tries));
    let requested = retry_after.and_then(|text| parse_retry_after(text, due.at)).unwrap_or_default();
    AfterAttempt::RetryAfter(pause.max(requested.min(MAX_RETRY_AFTER)))
}

/// A factor in [0.9, 1.1] by the delivery and the try, so that deliveries which failed together are not retried together.
fn jitter(id: DeliveryId, tries: u32) -> f64 {
    let draw = Digest::of(format!("{id}/{tries}").as_bytes()).as_bytes()[0];
    0.9 + 0.2 * f64::from(draw) / 255.0
}

/// Parses `Retry-After` in either form: seconds or a date.
fn parse_retry_after(text: &str, now: Timestamp) -> Option<Duration> {
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
    use crate::{domain::WebhookSecret, store::MAX_PAUSE};

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

    fn responded(status: u16, retry_after: Option<&str>) -> Result<Response, SendError> {
        Ok(Response { status, retry_after: retry_after.map(str::to_owned) })
    }

    #[test]
    fn a_delivery_has_at_most_ten_attempts() {
        for (tries, seconds) in (1..).zip(PAUSES) {
            let AfterAttempt::RetryAfter(pause) = result_of(&due(tries), responded(500, None)).next else {
                panic!("try {tries} is the last");
            };
            assert!(pause < MAX_PAUSE, "the store takes a longer one for a fault of the clock");
            let ratio = pause.as_secs_f64() / seconds as f64;
            assert!((0.9..=1.1).contains(&ratio), "try {tries}: {pause:?}");
        }
        assert_eq!(result_of(&due(10), responded(500, None)).next, AfterAttempt::GiveUp);
        assert_eq!(result_of(&due(10), Err(SendError::Timeout(15))).next, AfterAttempt::GiveUp);
    }

    #[test]
    fn only_2xx_is_success_and_410_disables_the_endpoint() {
        for status in [200, 202, 204, 299] {
            let result = result_of(&due(1), responded(status, None));
            assert_eq!((result.next, result.error), (AfterAttempt::Done, None));
        }
        assert_eq!(result_of(&due(1), responded(410, None)).next, AfterAttempt::DisableEndpoint);
        for status in [100, 301, 302, 307, 400, 404, 429, 500, 502] {
            let result = result_of(&due(1), responded(status, None));
            assert!(matches!(result.next, AfterAttempt::RetryAfter(_)), "{status}");
            assert!(result.error.is_some_and(|error| error.contains(&status.to_string())));
        }
    }

    #[test]
    fn an_endpoint_can_request_a_longer_pause_but_no_shorter_one() {
        let pause = |tries, requested| match result_of(&due(tries), responded(503, Some(requested))).next {
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
