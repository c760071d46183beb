//! The types that all layers share: those of [`tcgs_engine::domain`], and those of the service: jobs, keys, projects, webhooks, time.
//!
//! No I/O here, and no random numbers or time except from injected sources. Constructors refuse invalid values, so other layers need not
//! check them.

pub mod access;
mod defaults;
pub mod id;
pub mod job;
pub mod key;
pub mod outbound;
pub mod random_source;
pub mod session;
pub mod share;
pub mod viewer_token;
pub mod webhook;
pub mod webhook_secret;
pub mod workers;

pub(crate) use tcgs_codec::named_choice;
pub use tcgs_engine::domain::*;

pub use access::{Caller, Credential, DEFAULT_MAX_PRIORITY, MAX_PRIORITY, ProjectLimits, Scope};
pub(crate) use defaults::with_defaults;
pub use id::{DatasetId, DeliveryId, EndpointId, JobId, KeyId, ProjectId, ShareId, UploadId};
pub use job::{Event, EventKind, Job, JobState};
pub use key::{ApiKey, KeyHash, MalformedKey};
pub use outbound::{OutboundError, OutboundPolicy};
pub use random_source::{RandomError, RandomSource, SystemRandom};
pub use session::{MalformedSession, SessionToken};
pub use share::{MalformedShareToken, ShareSecret, ShareToken};
pub use viewer_token::ViewerToken;
pub use webhook::WebhookEvent;
pub use webhook_secret::WebhookSecret;
pub use workers::{Preparation, WorkerCounts, Workers};
