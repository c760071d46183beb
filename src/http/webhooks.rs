//! Webhook endpoints and what was delivered to them. What always holds: a secret is in the answer that makes its endpoint, and
//! in no other.

use std::str::FromStr;

use axum::{
    Json,
    extract::{Path, State},
    http::{HeaderValue, StatusCode, header},
    response::IntoResponse as _,
};
use serde::Deserialize;
use serde_json::{Value, json};

use super::{
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{ApiJson, JsonBody, Page, Parameters},
    state::AppState,
};
use crate::{
    domain::{Caller, EndpointId, ProblemType, WebhookEvent, WebhookSecret},
    store::{DeliveryRecord, EndpointRecord, NewEndpoint, Replay},
};

const MAX_DESCRIPTION: usize = 200;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CreateEndpointRequest {
    url: String,
    events: Option<Vec<String>>,
    description: Option<String>,
}

impl JsonBody for CreateEndpointRequest {
    const INVALID: ProblemType = ProblemType::InvalidEndpoint;
    const EXPECTED: &'static str = "a webhook endpoint";
}

fn href(id: EndpointId) -> String {
    format!("/v1/webhook-endpoints/{id}")
}

/// `POST /v1/webhook-endpoints`.
pub(super) async fn create(
    State(state): State<AppState>,
    caller: Caller,
    ApiJson(request): ApiJson<CreateEndpointRequest>,
) -> ApiResult {
    let CreateEndpointRequest { url, events, description } = request;
    let at_most = state.limits.webhook_endpoints;
    let url = state
        .limits
        .webhook_targets
        .check_url(&url)
        .map_err(|error| ProblemType::UrlNotAllowed.because(format!("url: {error}")))?;
    if description.as_ref().is_some_and(|text| text.chars().count() > MAX_DESCRIPTION) {
        return Err(invalid(format!("description: is longer than {MAX_DESCRIPTION} characters")));
    }
    let secret = WebhookSecret::generate(&*state.services.entropy)
        .map_err(|error| ProblemResponse::internal(&error))?;
    let new = NewEndpoint {
        id: EndpointId(state.services.new_uuid()),
        project: caller.project,
        url: url.into(),
        events: wanted(events)?,
        description,
        secret: secret.clone(),
    };
    let Some(record) = state.store().create_endpoint(new, at_most).await? else {
        return Err(ProblemType::TooManyEndpoints.because(format!(
            "there are {at_most} endpoints already, and there may be no more; delete one first"
        )));
    };
    tracing::info!(endpoint = %record.id, "endpoint {} is told of jobs", record.id);
    let location = HeaderValue::try_from(href(record.id))?;
    let body = Json(endpoint(&record, Some(&secret)));
    let headers =
        [(header::LOCATION, location), (header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
    Ok((StatusCode::CREATED, headers, body).into_response())
}

fn wanted(names: Option<Vec<String>>) -> ApiResult<Vec<WebhookEvent>> {
    let Some(names) = names else { return Ok(WebhookEvent::ALL.to_vec()) };
    let mut events = Vec::new();
    for name in names {
        let event: WebhookEvent = name.parse().map_err(|error| invalid(format!("events: {error}")))?;
        if events.contains(&event) {
            return Err(invalid(format!("events: '{name}' is given twice")));
        }
        events.push(event);
    }
    if events.is_empty() {
        return Err(invalid("events: is empty; leave it out to be told of all".into()));
    }
    Ok(events)
}

fn invalid(detail: String) -> ProblemResponse {
    ProblemType::InvalidEndpoint.because(detail)
}

/// `GET /v1/webhook-endpoints`.
pub(super) async fn list(State(state): State<AppState>, caller: Caller, parameters: Parameters) -> ApiResult {
    let page = page(parameters)?;
    let records = state.store().endpoints(caller.visible_project(), page.after, page.to_read()).await?;
    let body = |record: EndpointRecord| endpoint(&record, None);
    page.answer("endpoints", records, "/v1/webhook-endpoints", |last| last.id, body)
}

/// `GET /v1/webhook-endpoints/{id}`.
pub(super) async fn get(State(state): State<AppState>, caller: Caller, Path(id): Path<String>) -> ApiResult {
    let record = find(&state, &caller, &id).await?;
    Ok((no_store(), Json(endpoint(&record, None))).into_response())
}

/// `DELETE /v1/webhook-endpoints/{id}`.
pub(super) async fn delete(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
) -> ApiResult<StatusCode> {
    let record = find(&state, &caller, &id).await?;
    // Somebody else may have deleted it since; it is gone either way.
    state.store().delete_endpoint(record.id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// `GET /v1/webhook-endpoints/{id}/deliveries`.
pub(super) async fn deliveries(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    parameters: Parameters,
) -> ApiResult {
    let endpoint = find(&state, &caller, &id).await?.id;
    let page = page(parameters)?;
    let records = state.store().deliveries(endpoint, page.after, page.to_read()).await?;
    let list = format!("{}/deliveries", href(endpoint));
    page.answer("deliveries", records, &list, |last| last.seq, |record| delivery(endpoint, &record))
}

/// `POST /v1/webhook-endpoints/{id}/deliveries/{delivery}/replay`.
pub(super) async fn replay(
    State(state): State<AppState>,
    caller: Caller,
    Path((id, wanted)): Path<(String, String)>,
) -> ApiResult {
    let endpoint = find(&state, &caller, &id).await?.id;
    let unknown =
        || ProblemType::DeliveryNotFound.because(format!("endpoint {endpoint} has no such delivery"));
    let parsed = wanted.parse().map_err(|_| unknown())?;
    let refused = |kind: ProblemType, detail: &str| Err(kind.because(detail));
    match state.store().replay(endpoint, parsed).await?.ok_or_else(unknown)? {
        Replay::Due(record) => {
            Ok((StatusCode::ACCEPTED, no_store(), Json(delivery(endpoint, &record))).into_response())
        }
        Replay::InProgress => refused(ProblemType::DeliveryUnderWay, "an attempt is being made right now"),
        Replay::Disabled => refused(
            ProblemType::EndpointDisabled,
            "the endpoint answered 410 and gets no more deliveries; create a new one",
        ),
    }
}

async fn find(state: &AppState, caller: &Caller, id: &str) -> ApiResult<EndpointRecord> {
    let unknown = || ProblemType::EndpointNotFound.because("there is no such webhook endpoint");
    let parsed = id.parse().map_err(|_| unknown())?;
    let record = state.store().endpoint(parsed).await?;
    record.filter(|record| caller.may_see(record.project)).ok_or_else(unknown)
}

fn page<C: FromStr>(mut parameters: Parameters) -> ApiResult<Page<C>> {
    let page = Page::take(&mut parameters, |text| text.parse().ok())?;
    parameters.finish()?;
    Ok(page)
}

fn no_store() -> [(header::HeaderName, &'static str); 1] {
    [(header::CACHE_CONTROL, "no-store")]
}

/// `#/components/schemas/WebhookEndpoint` of the contract.
fn endpoint(record: &EndpointRecord, secret: Option<&WebhookSecret>) -> Value {
    let this = href(record.id);
    let mut body = json!({
        "id": record.id,
        "url": record.url,
        "events": record.events.iter().map(|event| event.name()).collect::<Vec<_>>(),
        "description": record.description,
        "created_at": record.created_at,
        "disabled_at": record.disabled_at,
    });
    if let Some(secret) = secret {
        body["secret"] = secret.expose().into();
    }
    body["links"] = json!({ "self": this, "deliveries": format!("{this}/deliveries") });
    body
}

/// `#/components/schemas/WebhookDelivery` of the contract.
fn delivery(endpoint: EndpointId, record: &DeliveryRecord) -> Value {
    json!({
        "id": record.id.to_string(),
        "event": record.event.name(),
        "job_id": record.job,
        "state": record.state,
        "attempts": record.attempts,
        "next_attempt_at": record.due_at,
        "created_at": record.created_at,
        "attempted_at": record.attempted_at,
        "delivered_at": record.delivered_at,
        "response_status": record.response_status,
        "error": record.error,
        "links": {
            "job": super::jobs::body::href(record.job),
            "replay": format!("{}/deliveries/{}/replay", href(endpoint), record.id),
        },
    })
}
