//! Who sent a request, as handlers take it: what [`super::auth`] made of the request's key.

use axum::{
    extract::FromRequestParts,
    http::request::Parts,
    response::{IntoResponse as _, Response},
};

use super::problem::Fault;
use crate::domain::Caller;

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Response;

    /// Refuses what did not pass the authentication: there is a way around it, and nobody may take it.
    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Response> {
        let known = parts.extensions.get::<Self>().copied();
        known.ok_or_else(|| {
            let fault = format!("{} reached its handler without authentication", parts.method);
            Fault::internal(&std::io::Error::other(fault)).into_response()
        })
    }
}
