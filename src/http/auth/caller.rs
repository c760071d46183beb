//! Who sent a request, as handlers get it: what [`crate::http::auth`] made of the request's key.

use std::convert::Infallible;

use axum::{
    extract::FromRequestParts,
    http::request::Parts,
    response::{IntoResponse as _, Response},
};

use crate::{
    domain::Caller,
    http::problem::{ApiResult, ProblemResponse},
};

/// The caller of a request that passed the authentication; other requests are refused.
pub(crate) fn caller(parts: &Parts) -> ApiResult<Caller> {
    parts.extensions.get().copied().ok_or_else(|| {
        let error = format!("{} reached its handler without authentication", parts.method);
        ProblemResponse::internal(&std::io::Error::other(error))
    })
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Response;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Response> {
        caller(parts).map_err(ProblemResponse::into_response)
    }
}

/// The caller of an operation that also answers those without a key.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OptionalCaller(pub(crate) Option<Caller>);

impl<S: Sync> FromRequestParts<S> for OptionalCaller {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(Self(parts.extensions.get().copied()))
    }
}
