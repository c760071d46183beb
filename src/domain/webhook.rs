//! Webhook events of jobs and their messages.

use std::str::FromStr;

use jiff::Timestamp;
use serde_json::json;

use super::{DeliveryId, Digest, EndpointId, JobId, JobState};

impl DeliveryId {
    /// The message to `endpoint` about the event number `seq` of `job`: a UUID of version 8 that those three decide, so that it
    /// needs no randomness.
    #[must_use]
    pub fn of(endpoint: EndpointId, job: JobId, seq: u64) -> Self {
        let digest = Digest::of(format!("{endpoint}/{job}/{seq}").as_bytes());
        let mut bytes = [0; 16];
        bytes.copy_from_slice(&digest.as_bytes()[..16]);
        Self(uuid::Builder::from_custom_bytes(bytes).into_uuid())
    }
}

/// An event: a job entered a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WebhookEvent(pub JobState);

impl WebhookEvent {
    /// Every event.
    pub const ALL: [Self; 5] = [
        Self(JobState::Queued),
        Self(JobState::Running),
        Self(JobState::Succeeded),
        Self(JobState::Failed),
        Self(JobState::Cancelled),
    ];

    /// The name in the API and in messages.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self.0 {
            JobState::Queued => "job.queued",
            JobState::Running => "job.running",
            JobState::Succeeded => "job.succeeded",
            JobState::Failed => "job.failed",
            JobState::Cancelled => "job.cancelled",
        }
    }

    /// The message. It only names the job, so that the receiver reads the current state with its own key.
    #[must_use]
    pub fn message(self, job: JobId, attempt: u32, seq: u64, at: Timestamp) -> String {
        let this = format!("/v1/jobs/{job}");
        json!({
            "type": self.name(),
            "timestamp": at,
            "data": {
                "job_id": job,
                "state": self.0,
                "attempt": attempt,
                "seq": seq,
                "links": { "self": this, "events": format!("{this}/events"), "artifact": format!("{this}/artifact") },
            },
        })
        .to_string()
    }
}

impl FromStr for WebhookEvent {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|event| event.name() == text).ok_or_else(|| {
            let known: Vec<&str> = Self::ALL.iter().map(|event| event.name()).collect();
            format!("'{text}' is not an event; there are {}", known.join(", "))
        })
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn a_message_is_thin_and_its_identity_is_decided_by_what_it_tells() {
        let (endpoint, job) = (EndpointId(Uuid::from_u128(1)), JobId(Uuid::from_u128(2)));
        assert_eq!(DeliveryId::of(endpoint, job, 3), DeliveryId::of(endpoint, job, 3));
        assert_ne!(DeliveryId::of(endpoint, job, 3), DeliveryId::of(endpoint, job, 4));
        assert_eq!(DeliveryId::of(endpoint, job, 3).0.get_version_num(), 8);
        for event in WebhookEvent::ALL {
            assert_eq!(event.name().parse(), Ok(event));
            assert!(event.message(job, u32::MAX, u64::MAX, Timestamp::UNIX_EPOCH).len() < 1000);
        }
        assert!("job.paused".parse::<WebhookEvent>().expect_err("unknown").contains("job.succeeded"));
    }
}
