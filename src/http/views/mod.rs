//! Rendered views of a finished job's scene: one or several here, streams and animations in [`sequence`]; and the
//! cameras of its dataset.

mod camera;
pub(super) mod cameras;
mod frame_stream;
pub(super) mod sequence;

use std::sync::Arc;

use axum::{
    body::Body,
    extract::State,
    http::{HeaderMap, HeaderName, HeaderValue, header},
    response::{IntoResponse as _, Response},
};
use serde::Deserialize;

use self::{
    camera::{CameraSpec, invalid_view},
    frame_stream::{BodyFormat, FrameStream, Multipart, StopCondition},
};
use super::{
    config::RequestLimits,
    files::{document, file_of, in_pieces, take_lambda},
    jobs::OwnedJob,
    problem::{Answer as _, ApiResult, ProblemResponse},
    rendering::{
        Admission, Format, FrameSpec, Output, Picture, PictureKind, RenderFrame, SettingError, Timing,
    },
    request::{ApiJson, Etag, JsonBody, Parameters, not_modified, prefers},
    shared::Held,
    state::AppState,
};
use crate::{
    domain::{Caller, Camera, NamedCamera, ProblemType, ViewRequest},
    store::{ArtifactKind, BlobRef, JobRecord},
};

const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");
/// Header: world units per step of a 16-bit depth.
const DEPTH_SCALE: HeaderName = HeaderName::from_static("x-depth-scale");

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RenderViewsRequest {
    views: Vec<ViewRequest>,
    output: Option<Output>,
    format: Option<Format>,
    quality: Option<u8>,
    /// Which file of a rate-distortion curve.
    lambda: Option<f64>,
}

impl JsonBody for RenderViewsRequest {
    const INVALID: ProblemType = ProblemType::InvalidView;
    const EXPECTED: &'static str = "a request for views";
}

/// What the query of `GET /v1/jobs/{id}/view` asks for.
#[derive(Debug)]
pub(super) struct ViewQuery {
    pub(super) kind: PictureKind,
    pub(super) lambda: Option<f64>,
    pub(super) spec: CameraSpec,
}

impl ViewQuery {
    pub(super) fn take(mut parameters: Parameters) -> ApiResult<Self> {
        let kind = take_kind(&mut parameters, Format::Png)?;
        let lambda = take_lambda(&mut parameters)?;
        let request = CameraSpec::take(&mut parameters)?;
        // Before what is missing: a parameter that is no parameter was meant for it.
        parameters.finish()?;
        Ok(Self { kind, lambda, spec: CameraSpec::from_query(request)? })
    }
}

/// `GET /v1/jobs/{id}/view`.
pub(super) async fn get(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    caller: Caller,
    parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let ViewQuery { kind, lambda, spec } = ViewQuery::take(parameters)?;
    let cameras = cameras(&state, &record, vec![spec]).await?;
    let frame = frames(&state, &record, lambda, &cameras, kind)?.remove(0);
    let etag = Etag::new(frame.key());
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        single(&state, &caller, frame).await?
    };
    cache_for_a_day(&mut response, &etag);
    Ok(response)
}

/// `POST /v1/jobs/{id}/views`.
pub(super) async fn post(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    caller: Caller,
    headers: HeaderMap,
    ApiJson(request): ApiJson<RenderViewsRequest>,
) -> ApiResult {
    let RenderViewsRequest { views, output, format, quality, lambda } = request;
    let kind = PictureKind::new(output, format, quality, Format::Png).map_err(bad_field)?;
    let max = state.limits.views;
    if !(1..=max).contains(&views.len()) {
        return Err(invalid_view(format!(
            "views: {} views were requested; 1 to {max} are possible",
            views.len()
        )));
    }
    let cameras = cameras(&state, &record, specs("views", views)?).await?;
    let mut frames = frames(&state, &record, lambda, &cameras, kind)?;
    let mut response = if frames.len() == 1 {
        single(&state, &caller, frames.remove(0)).await?
    } else {
        let slot = state.view_renderer.enter(caller.credential(), Admission::Request(frames.len()))?;
        let stream = FrameStream { frames, rounds: 1, every: None, stop: StopCondition::WhenDone };
        let is_form = prefers(&headers, "multipart/form-data", "multipart/mixed");
        let kind = if is_form { Multipart::Form } else { Multipart::Mixed };
        stream.answer(&state, slot, BodyFormat::Multipart(kind)).await?
    };
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(response)
}

/// A response with one picture.
async fn single(state: &AppState, caller: &Caller, frame: RenderFrame) -> ApiResult {
    let (picture, timing) = match state.view_renderer.cached(frame.key()) {
        Some(found) => found,
        None => {
            let slot = state.view_renderer.enter(caller.credential(), Admission::Request(1))?;
            state.view_renderer.picture(&slot, frame, || ()).await?
        }
    };
    let held = state.held_bytes.hold(picture.bytes.len())?;
    Ok(answer(picture, &timing, held))
}

fn answer(picture: Picture, timing: &Timing, held: Held) -> Response {
    let media_type = HeaderValue::from_static(picture.media_type());
    let scale = picture.depth_scale().and_then(|scale| HeaderValue::try_from(scale.to_string()).ok());
    let length = picture.bytes.len();
    let mut response = match held.is_counted() {
        true => Body::from_stream(in_pieces(picture.bytes, held)).into_response(),
        false => picture.bytes.into_response(),
    };
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_LENGTH, length.into());
    headers.insert(header::CONTENT_TYPE, media_type);
    headers.insert(SERVER_TIMING, timing.header());
    if let Some(scale) = scale {
        headers.insert(DEPTH_SCALE, scale);
    }
    response
}

/// Lets the client cache the response for a day. A finished job's file never changes; the renderer may, with the next version of this
/// program.
fn cache_for_a_day(response: &mut Response, etag: &Etag) {
    let headers = response.headers_mut();
    headers.insert(header::ETAG, etag.value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, max-age=86400"));
}

fn take_kind(parameters: &mut Parameters, default: Format) -> ApiResult<PictureKind> {
    let output = parameters.take_as("output", "one of color, depth, alpha")?;
    let format = parameters.take_as("format", "one of png, jpeg, webp, npy")?;
    let quality = parameters.take_as("quality", "a whole number from 1 to 100")?;
    PictureKind::new(output, format, quality, default).map_err(bad_parameter)
}

fn bad_parameter((name, error): SettingError) -> ProblemResponse {
    ProblemResponse::parameter(name, error)
}

fn bad_field((name, error): SettingError) -> ProblemResponse {
    invalid_view(format!("{name}: {error}"))
}

/// The cameras of a JSON list; errors name the list and the index.
fn specs(list: &str, views: Vec<ViewRequest>) -> ApiResult<Vec<CameraSpec>> {
    views.into_iter().enumerate().map(|(index, view)| CameraSpec::from_body(list, index, view)).collect()
}

/// The resolved cameras; reads the dataset's cameras if any is needed.
async fn cameras(state: &AppState, record: &JobRecord, specs: Vec<CameraSpec>) -> ApiResult<Vec<Camera>> {
    let named = if specs.iter().any(CameraSpec::needs_cameras) {
        dataset_cameras(state, record).await?
    } else {
        Vec::new()
    };
    specs.into_iter().map(|spec| spec.resolve(&named)).collect()
}

/// The artifact with the dataset's cameras.
fn cameras_blob(record: &JobRecord) -> ApiResult<BlobRef> {
    let error = || ProblemResponse::no_file_yet(record.job.id, record.job.state.name());
    record.artifact(ArtifactKind::Cameras).ok_or_else(error)
}

async fn dataset_cameras(state: &AppState, record: &JobRecord) -> ApiResult<Vec<NamedCamera>> {
    let none = || ProblemResponse::no_file_yet(record.job.id, record.job.state.name());
    document(state, record, ArtifactKind::Cameras).await?.ok_or_else(none)
}

/// Frames of one file, within the limits on size.
fn frames(
    state: &AppState,
    record: &JobRecord,
    lambda: Option<f64>,
    cameras: &[Camera],
    kind: PictureKind,
) -> ApiResult<Vec<RenderFrame>> {
    check_size(cameras, &state.limits)?;
    frames_of_any_size(state, record, lambda, cameras, kind)
}

fn frames_of_any_size(
    state: &AppState,
    record: &JobRecord,
    lambda: Option<f64>,
    cameras: &[Camera],
    kind: PictureKind,
) -> ApiResult<Vec<RenderFrame>> {
    let artifact = file_of(record, lambda)?.blob.digest;
    let renderer = state.services.engine.renderer(artifact)?;
    let spec = |&camera| FrameSpec { artifact, camera, kind };
    Ok(cameras.iter().map(spec).map(|spec| RenderFrame { spec, renderer: Arc::clone(&renderer) }).collect())
}

/// Checks the limits of one request: pixels of a side, and pixels of all pictures together.
pub(super) fn check_size(cameras: &[Camera], limits: &RequestLimits) -> ApiResult<()> {
    check_sides(cameras, limits.view_side)?;
    check_pixels(cameras, limits.view_pixels)
}

fn check_sides(cameras: &[Camera], max: u32) -> ApiResult<()> {
    for Camera { intrinsics, .. } in cameras {
        let (width, height) = (intrinsics.width, intrinsics.height);
        if width.max(height) > max {
            return Err(too_large(format!("{width}x{height} is more than {max} pixels per side")));
        }
    }
    Ok(())
}

fn check_pixels(cameras: &[Camera], max: u64) -> ApiResult<()> {
    let pixels: u64 = cameras
        .iter()
        .map(|camera| u64::from(camera.intrinsics.width) * u64::from(camera.intrinsics.height))
        .sum();
    if pixels > max {
        return Err(too_large(format!(
            "{pixels} pixels in all are more than the {max} that one request may ask for"
        )));
    }
    Ok(())
}

fn too_large(detail: String) -> ProblemResponse {
    ProblemType::ViewTooLarge.because(detail)
}
