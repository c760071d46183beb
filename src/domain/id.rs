//! Identifiers: UUIDs, a type for each kind.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use uuid::Uuid;

macro_rules! identities {
    ($($(#[$says:meta])+ $name:ident;)+) => {$(
        $(#[$says])+
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub Uuid);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }

        impl FromStr for $name {
            type Err = uuid::Error;

            fn from_str(text: &str) -> Result<Self, uuid::Error> {
                text.parse().map(Self)
            }
        }
    )+};
}

identities! {
    /// A job's identity: a UUID whose order is the order of creation (version 7).
    JobId;
    /// The identity of a stored dataset: a UUID whose order is the order of creation (version 7).
    DatasetId;
    /// An upload's identity: a UUID whose order is the order of creation (version 7).
    UploadId;
    /// A project's identity: a UUID of version 7, or [`ProjectId::DEFAULT`]. What is created belongs to a project.
    ProjectId;
    /// A key's identity: a UUID of version 7.
    KeyId;
    /// The identity of a shared link: a UUID of version 7.
    ShareId;
    /// An endpoint's identity: a UUID of version 7.
    EndpointId;
    /// A message's identity to one endpoint, the same in every attempt to deliver it.
    DeliveryId;
}

impl ProjectId {
    /// The project of everything that is created without a key: the nil UUID.
    pub const DEFAULT: Self = Self(Uuid::nil());
}
