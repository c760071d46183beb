//! The two names of a dataset in the API: `/v1/datasets` and, from earlier versions, `/v1/scenes`. Answers use the name of the request.

use std::convert::Infallible;

use axum::{extract::FromRequestParts, http::request::Parts};

use crate::domain::DatasetId;

/// The name that a request used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Naming {
    Datasets,
    Scenes,
}

impl Naming {
    fn of(path: &str) -> Self {
        if path.starts_with("/v1/datasets") { Self::Datasets } else { Self::Scenes }
    }

    /// The field of a list.
    pub(crate) fn list(self) -> &'static str {
        match self {
            Self::Datasets => "datasets",
            Self::Scenes => "scenes",
        }
    }

    /// The path of the list.
    pub(crate) fn path(self) -> &'static str {
        match self {
            Self::Datasets => "/v1/datasets",
            Self::Scenes => "/v1/scenes",
        }
    }

    /// The path of one dataset.
    pub(crate) fn href(self, id: DatasetId) -> String {
        format!("{}/{id}", self.path())
    }

    /// The path of the jobs that were created from it.
    pub(crate) fn jobs(self, id: DatasetId) -> String {
        match self {
            Self::Datasets => format!("/v1/jobs?dataset_id={id}"),
            Self::Scenes => format!("/v1/jobs?scene_id={id}"),
        }
    }
}

impl<S: Sync> FromRequestParts<S> for Naming {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(Self::of(parts.uri.path()))
    }
}
