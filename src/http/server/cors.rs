//! Cross-origin resource sharing (Fetch standard, "CORS protocol") for pages of the origins that the operator names.
//!
//! A preflight is answered before authentication, since browsers send it without a key. Credentials are not allowed: a page sends its key
//! as a bearer token.

use std::time::Duration;

use axum::{
    extract::{Request, State},
    http::{HeaderValue, Method, header},
    middleware::Next,
    response::Response,
};
use tower::{Layer as _, ServiceExt as _};
use tower_http::cors::{AllowHeaders, AllowOrigin, CorsLayer, ExposeHeaders};

use crate::http::origins::AllowedOrigins;

/// How long browsers may remember the answer to a preflight; they have bounds of their own, mostly two hours.
const MAX_AGE: Duration = Duration::from_secs(2 * 3600);

/// What the middleware needs.
#[derive(Debug, Clone)]
pub(crate) struct Cors {
    origins: AllowedOrigins,
    layer: CorsLayer,
}

impl Cors {
    pub(crate) fn new(origins: &AllowedOrigins) -> Self {
        let list = origins.0.iter().filter_map(|origin| HeaderValue::try_from(origin.to_string()).ok());
        let methods =
            [Method::GET, Method::HEAD, Method::POST, Method::PATCH, Method::DELETE, Method::OPTIONS];
        let layer = CorsLayer::new()
            .allow_origin(AllowOrigin::list(list))
            .allow_methods(methods)
            // `*` would not include Authorization.
            .allow_headers(AllowHeaders::mirror_request())
            .expose_headers(ExposeHeaders::any())
            .max_age(MAX_AGE);
        Self { origins: origins.clone(), layer }
    }

    /// Whether a request is a preflight of a page that may use the API.
    fn is_preflight(&self, request: &Request) -> bool {
        let headers = request.headers();
        let origin = headers.get(header::ORIGIN).and_then(|origin| origin.to_str().ok());
        request.method() == Method::OPTIONS
            && headers.contains_key(header::ACCESS_CONTROL_REQUEST_METHOD)
            && origin.is_some_and(|origin| self.origins.allow(origin))
    }
}

/// Answers preflights, and lets pages of these origins read the other answers. Other `OPTIONS` requests are operations.
pub(crate) async fn share(State(cors): State<Cors>, request: Request, next: Next) -> Response {
    if request.method() == Method::OPTIONS && !cors.is_preflight(&request) {
        return next.run(request).await;
    }
    match cors.layer.layer(next).oneshot(request).await {
        Ok(response) => response,
        Err(never) => match never {},
    }
}
