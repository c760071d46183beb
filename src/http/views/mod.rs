//! Rendered views of a finished job's scene: single ones and several at once here, streams and animations in
//! [`sequence`].

mod apng;
mod film;
mod key;
mod queue;
pub(super) mod sequence;
mod studio;

use axum::{
    body::Body,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use serde::{Deserialize, de::DeserializeOwned};

pub(super) use self::studio::Studio;
use self::{
    film::{Ends, Film, Parts, Wrapping},
    key::Shot,
    queue::Visit,
    studio::{Timing, picture},
};
use super::{
    artifact::{file_of, take_lambda},
    body::read_json,
    camera::{CameraSpec, invalid_view},
    etag::{Etag, not_modified},
    jobs::find,
    picture::{BadSetting, Format, Output, Picture, PictureKind},
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, Camera, NamedCamera, ViewRequest},
    store::{ArtifactKind, JobRecord},
};

const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");
/// World units that one step of a 16-bit depth stands for.
const DEPTH_SCALE: HeaderName = HeaderName::from_static("x-depth-scale");

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewsBody {
    views: Vec<ViewRequest>,
    #[serde(default)]
    output: Option<Output>,
    #[serde(default)]
    format: Option<Format>,
    #[serde(default)]
    quality: Option<u8>,
    /// Which file of a rate-distortion curve.
    #[serde(default)]
    lambda: Option<f64>,
}

/// `GET /v1/jobs/{id}/view`.
pub(super) async fn get(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
    headers: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let mut parameters = Parameters::parse(query.as_deref())?;
    let kind = take_kind(&mut parameters, Format::Png)?;
    let lambda = take_lambda(&mut parameters)?;
    let spec = CameraSpec::from_query(&mut parameters)?;
    parameters.finish()?;
    let cameras = cameras(&state, &record, vec![spec]).await?;
    let shot = shots(&state, &record, lambda, &cameras, kind)?.remove(0);
    let etag = state.studio().key(&shot).etag();
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        single(&state, &caller, shot).await?
    };
    keep_a_day(&mut response, &etag);
    Ok(response)
}

/// `POST /v1/jobs/{id}/views`.
pub(super) async fn post(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let ViewsBody { views, output, format, quality, lambda } = read(&state, &headers, body).await?;
    let kind = PictureKind::new(output, format, quality, Format::Png).map_err(bad_field)?;
    let most = state.limits().views;
    if !(1..=most).contains(&views.len()) {
        return Err(invalid_view(format!(
            "views: {} views were asked for; 1 to {most} are possible",
            views.len()
        )));
    }
    let cameras = cameras(&state, &record, specs("views", views)?).await?;
    let mut shots = shots(&state, &record, lambda, &cameras, kind)?;
    let mut response = if shots.len() == 1 {
        single(&state, &caller, shots.remove(0)).await?
    } else {
        let place = state.studio().queue.enter(caller.key, Visit::Request(shots.len()))?;
        let film = Film { shots, rounds: 1, every: None, ends: Ends::WhenDone };
        film.answer(&state, place, Wrapping::Parts(Parts::Mixed)).await?
    };
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(response)
}

/// One picture as the whole answer.
async fn single(state: &AppState, caller: &Caller, shot: Shot) -> Result<Response, Fault> {
    let key = state.studio().key(&shot);
    let (picture, timing) = match state.studio().at_hand(key) {
        Some(found) => found,
        None => {
            let mut place = state.studio().queue.enter(caller.key, Visit::Request(1))?;
            picture(state, &mut place, shot).await?
        }
    };
    Ok(answer(picture, &timing))
}

fn answer(picture: Picture, timing: &Timing) -> Response {
    let media_type = HeaderValue::from_static(picture.media_type());
    let scale = picture.depth_scale().and_then(|scale| HeaderValue::try_from(scale.to_string()).ok());
    let mut response = picture.bytes.into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, media_type);
    headers.insert(SERVER_TIMING, timing.header());
    if let Some(scale) = scale {
        headers.insert(DEPTH_SCALE, scale);
    }
    response
}

/// Lets the client keep what the tag names. A finished job's file never changes; the renderer may, with the next version
/// of this program.
fn keep_a_day(response: &mut Response, etag: &Etag) {
    let headers = response.headers_mut();
    headers.insert(header::ETAG, etag.value());
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, max-age=86400"));
}

fn take_kind(parameters: &mut Parameters, usual: Format) -> Result<PictureKind, Fault> {
    let output = parameters.take_as("output", "one of color, depth, alpha")?;
    let format = parameters.take_as("format", "one of png, jpeg, webp, npy")?;
    let quality = parameters.take_as("quality", "a whole number from 1 to 100")?;
    let fault = |(name, fault): BadSetting| Fault::parameter(name, fault);
    PictureKind::new(output, format, quality, usual).map_err(fault)
}

fn bad_field((name, fault): BadSetting) -> Fault {
    invalid_view(format!("{name}: {fault}"))
}

/// Reads a body of JSON.
async fn read<T: DeserializeOwned>(state: &AppState, headers: &HeaderMap, body: Body) -> Result<T, Fault> {
    let content = read_json(&mut body.into_data_stream(), headers, state.limits()).await?;
    serde_json::from_slice(&content).map_err(|error| {
        if error.is_data() {
            return invalid_view(format!("the body is not a request for views: {error}"));
        }
        let detail = format!("the body is not JSON: {error}");
        Fault::new(StatusCode::BAD_REQUEST, "malformed-json", "Malformed JSON", detail)
    })
}

/// The views of a JSON list; a fault names the list and the place.
fn specs(list: &str, views: Vec<ViewRequest>) -> Result<Vec<CameraSpec>, Fault> {
    views.into_iter().enumerate().map(|(index, view)| CameraSpec::from_body(list, index, view)).collect()
}

/// The cameras that are meant; the dataset's are read if any is needed.
async fn cameras(state: &AppState, record: &JobRecord, specs: Vec<CameraSpec>) -> Result<Vec<Camera>, Fault> {
    let named = if specs.iter().any(CameraSpec::needs_cameras) {
        dataset_cameras(state, record).await?
    } else {
        Vec::new()
    };
    specs.into_iter().map(|spec| spec.resolve(&named)).collect()
}

async fn dataset_cameras(state: &AppState, record: &JobRecord) -> Result<Vec<NamedCamera>, Fault> {
    let fault = || Fault::no_file_yet(record.job.id, record.job.state.name());
    let blob = record.artifact(ArtifactKind::Cameras).ok_or_else(fault)?;
    let content = state.blobs().read(blob.digest).await?;
    serde_json::from_slice(&content).map_err(|error| Fault::internal(&error))
}

/// Pictures of one file, if together they are not too large.
fn shots(
    state: &AppState,
    record: &JobRecord,
    lambda: Option<f64>,
    cameras: &[Camera],
    kind: PictureKind,
) -> Result<Vec<Shot>, Fault> {
    check_sides(state, cameras)?;
    check_pixels(cameras, state.limits().view_pixels)?;
    shots_of_any_size(record, lambda, cameras, kind)
}

fn shots_of_any_size(
    record: &JobRecord,
    lambda: Option<f64>,
    cameras: &[Camera],
    kind: PictureKind,
) -> Result<Vec<Shot>, Fault> {
    let artifact = file_of(record, lambda)?.blob.digest;
    Ok(cameras.iter().map(|&camera| Shot { artifact, camera, kind }).collect())
}

fn check_sides(state: &AppState, cameras: &[Camera]) -> Result<(), Fault> {
    let most = state.limits().view_side;
    for Camera { intrinsics, .. } in cameras {
        let (width, height) = (intrinsics.width, intrinsics.height);
        if width.max(height) > most {
            return Err(too_large(format!("{width}x{height} is more than {most} pixels a side")));
        }
    }
    Ok(())
}

fn check_pixels(cameras: &[Camera], most: u64) -> Result<(), Fault> {
    let pixels: u64 = cameras
        .iter()
        .map(|camera| u64::from(camera.intrinsics.width) * u64::from(camera.intrinsics.height))
        .sum();
    if pixels > most {
        return Err(too_large(format!(
            "{pixels} pixels in all are more than the {most} that one request may ask for"
        )));
    }
    Ok(())
}

fn too_large(detail: String) -> Fault {
    Fault::new(StatusCode::UNPROCESSABLE_ENTITY, "view-too-large", "View too large", detail)
}
