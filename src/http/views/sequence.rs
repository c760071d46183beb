//! Streams and animations: around the scene, or along a path of views.

use std::{convert::Infallible, time::Duration};

use axum::{
    body::Body,
    extract::State,
    http::{HeaderMap, HeaderValue, header},
    response::Response,
};
use bytes::Bytes;
use futures_util::{StreamExt as _, stream};
use serde::Deserialize;

use super::{
    bad_field, bad_parameter, cache_for_a_day,
    camera::{impossible, impossible_view, invalid_view, scaled, side},
    cameras, check_pixels, check_sides, dataset_cameras,
    frame_stream::{BodyFormat, FrameStream, Multipart, StopCondition},
    frames_of_any_size, specs, take_kind, too_large,
};
use crate::{
    domain::{Caller, Camera, Intrinsics, Orbit, ProblemType, Split, ViewRequest, camera_path},
    http::{
        files::take_lambda,
        jobs::OwnedJob,
        problem::{ApiResult, ProblemResponse},
        rendering::{Admission, AnimationFormat, Format, PictureKind, failed},
        request::{ApiJson, Etag, JsonBody, Parameters, not_modified},
        state::AppState,
    },
    picture::WebpAnimation,
    store::JobRecord,
};

const DEFAULT_FRAMES: u32 = 72;
const DEFAULT_RATE: u32 = 12;
const MAX_RATE: u32 = 60;
const MAX_ROUNDS: u32 = 1000;
/// Most views of a path.
const MAX_KEYS: usize = 64;
/// Longest file that is sent only once it is whole.
const MAX_WHOLE_BYTES: usize = 64 << 20;
/// Largest default width of an orbit's pictures.
const DEFAULT_WIDTH: u32 = 640;

/// `GET /v1/jobs/{id}/stream`.
pub(crate) async fn stream(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    caller: Caller,
    mut parameters: Parameters,
) -> ApiResult {
    let rounds = parameters.take_count("orbit", 1, MAX_ROUNDS)?;
    let rate = parameters.take_count("fps", DEFAULT_RATE, MAX_RATE)?;
    let kind = take_kind(&mut parameters, Format::Jpeg)?;
    let lambda = take_lambda(&mut parameters)?;
    let orbit = OrbitSpec::take(&mut parameters, state.limits.frames)?;
    parameters.finish()?;
    let cameras = orbit.cameras(&state, &record).await?;
    let frames = frames_of_any_size(&state, &record, lambda, &cameras, kind)?;
    let every = Some(Duration::from_secs(1) / rate);
    let stream = FrameStream { frames, rounds, every, stop: StopCondition::Revoked(caller.credential()) };
    let slot = state.view_renderer.enter(caller.credential(), Admission::Stream)?;
    let mut response = stream.answer(&state, slot, BodyFormat::Multipart(Multipart::Replace)).await?;
    let headers = response.headers_mut();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    // Proxies that know the header forward each picture at once.
    headers.insert("x-accel-buffering", HeaderValue::from_static("no"));
    Ok(response)
}

/// `GET /v1/jobs/{id}/animation`.
pub(crate) async fn animation(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    caller: Caller,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let rate = parameters.take_count("fps", DEFAULT_RATE, MAX_RATE)?;
    let lambda = take_lambda(&mut parameters)?;
    let format: AnimationFormat = parameters.take_as("format", "one of apng, webp")?.unwrap_or_default();
    let quality = parameters.take_as("quality", "a whole number from 1 to 100")?;
    let orbit = OrbitSpec::take(&mut parameters, state.limits.frames)?;
    parameters.finish()?;
    let kind = format.of_frames(quality).map_err(bad_parameter)?;
    let stream = animated(&state, &record, lambda, &orbit.cameras(&state, &record).await?, kind)?;
    let etag = Etag::new(stream.key(&format!("{} at {rate}", format.name())));
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        shown(&state, &caller, stream, rate, format).await?
    };
    cache_for_a_day(&mut response, &etag);
    Ok(response)
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct AnimationRequest {
    path: Vec<ViewRequest>,
    frames: Option<u32>,
    #[serde(default)]
    closed: bool,
    fps: Option<u32>,
    lambda: Option<f64>,
    format: Option<AnimationFormat>,
    quality: Option<u8>,
}

impl JsonBody for AnimationRequest {
    const INVALID: ProblemType = ProblemType::InvalidView;
    const EXPECTED: &'static str = "a path of views";
}

/// `POST /v1/jobs/{id}/animation`.
pub(crate) async fn animation_path(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    caller: Caller,
    ApiJson(request): ApiJson<AnimationRequest>,
) -> ApiResult {
    let AnimationRequest { path, frames, closed, fps, lambda, format, quality } = request;
    let format = format.unwrap_or_default();
    let kind = format.of_frames(quality).map_err(bad_field)?;
    let rate = count("fps", fps, DEFAULT_RATE, MAX_RATE)?;
    let path = PathSpec { keys: path, frames, closed };
    let stream = animated(&state, &record, lambda, &path.cameras(&state, &record).await?, kind)?;
    let mut response = shown(&state, &caller, stream, rate, format).await?;
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(response)
}

fn animated(
    state: &AppState,
    record: &JobRecord,
    lambda: Option<f64>,
    cameras: &[Camera],
    kind: PictureKind,
) -> ApiResult<FrameStream> {
    check_pixels(cameras, state.limits.animation_pixels)?;
    let frames = frames_of_any_size(state, record, lambda, cameras, kind)?;
    Ok(FrameStream { frames, rounds: 1, every: None, stop: StopCondition::WhenDone })
}

async fn shown(
    state: &AppState,
    caller: &Caller,
    stream: FrameStream,
    rate: u32,
    format: AnimationFormat,
) -> ApiResult {
    let slot = state.view_renderer.enter(caller.credential(), Admission::Request(stream.frames.len()))?;
    let rate = u16::try_from(rate).unwrap_or(u16::MAX);
    match format {
        AnimationFormat::Apng => {
            stream.answer(state, slot, BodyFormat::Apng { frames_per_second: rate }).await
        }
        AnimationFormat::Webp => {
            let size = stream.frames[0].spec.camera.intrinsics;
            let file = WebpAnimation { rate, size: [size.width, size.height] };
            let frames = stream.answer(state, slot, BodyFormat::WebpFrames(file.clone())).await?;
            whole(state, &file, frames).await
        }
    }
}

/// The response with the whole file, which begins with its length, once all frames are there.
async fn whole(state: &AppState, file: &WebpAnimation, frames: Response) -> ApiResult {
    let (mut head, body) = frames.into_parts();
    let (mut parts, mut length) = (vec![Bytes::new()], 0);
    let mut held = state.held_bytes.hold(0)?;
    let mut body = body.into_data_stream();
    while let Some(part) = body.next().await {
        let part = part.map_err(|error| failed(&error))?;
        length += part.len();
        if length > MAX_WHOLE_BYTES {
            return Err(too_large(format!(
                "the file is longer than {MAX_WHOLE_BYTES} bytes; ask for fewer or smaller pictures, or for apng, which is sent as it is rendered"
            )));
        }
        state.held_bytes.grow(&mut held, length)?;
        parts.push(part);
    }
    let begin = file.head(length).map_err(|error| failed(&error))?;
    head.headers.insert(header::CONTENT_LENGTH, (begin.len() + length).into());
    parts[0] = begin.into();
    // The room is given back with the last part.
    let sent = parts.into_iter().map(move |part| {
        let _ = &held;
        Ok::<_, Infallible>(part)
    });
    Ok(Response::from_parts(head, Body::from_stream(stream::iter(sent))))
}

/// A number of a JSON body from 1 to `max`, or `default`.
fn count(name: &str, given: Option<u32>, default: u32, max: u32) -> ApiResult<u32> {
    let count = given.unwrap_or(default);
    if !(1..=max).contains(&count) {
        return Err(invalid_view(format!("{name}: {count} is outside 1..={max}")));
    }
    Ok(count)
}

/// One orbit around the scene.
#[derive(Debug)]
struct OrbitSpec {
    frames: u32,
    radius: f64,
    elevation: Option<f64>,
    width: Option<u32>,
    height: Option<u32>,
}

impl OrbitSpec {
    fn take(parameters: &mut Parameters, max_frames: u32) -> ApiResult<Self> {
        let frames = parameters.take_count("frames", DEFAULT_FRAMES.min(max_frames), max_frames)?;
        let radius = parameters.take_as("radius", "a number")?.unwrap_or(1.0);
        if !(0.05..=20.0).contains(&radius) {
            return Err(ProblemResponse::parameter("radius", format!("{radius} is outside 0.05..=20")));
        }
        let elevation: Option<f64> = parameters.take_as("elevation", "a number of degrees")?;
        if let Some(elevation) = elevation.filter(|elevation| !(-89.0..=89.0).contains(elevation)) {
            return Err(ProblemResponse::parameter(
                "elevation",
                format!("{elevation} is outside -89..=89 degrees"),
            ));
        }
        let (width, height) = (side(parameters, "width")?, side(parameters, "height")?);
        Ok(Self { frames, radius, elevation, width, height })
    }

    /// Cameras around the point that the training cameras look at, with the field of view of the first of them.
    async fn cameras(&self, state: &AppState, record: &JobRecord) -> ApiResult<Vec<Camera>> {
        let named = dataset_cameras(state, record).await?;
        let training: Vec<Camera> =
            named.iter().filter(|camera| camera.split == Split::Train).map(|camera| camera.camera).collect();
        let no_cameras =
            || impossible_view("the dataset has no training cameras to go around with".to_owned());
        let orbit = Orbit::around(&training).ok_or_else(no_cameras)?;
        let orbit = self.elevation.map_or(orbit, |degrees| orbit.at_elevation(degrees)).scaled(self.radius);
        let seen = training.first().ok_or_else(no_cameras)?.intrinsics;
        let width = match (self.width, self.height) {
            (None, None) => Some(seen.width.min(DEFAULT_WIDTH)),
            (width, _) => width,
        };
        let scaled = scaled(seen, width, self.height).map_err(impossible)?;
        let middle = |side: u32| f64::from(side) / 2.0;
        let intrinsics = Intrinsics { cx: middle(scaled.width), cy: middle(scaled.height), ..scaled };
        let at = |frame: u32| {
            let pose = orbit.pose(f64::from(frame) / f64::from(self.frames)).map_err(impossible)?;
            Camera::new(intrinsics, pose).map_err(impossible)
        };
        let cameras = (0..self.frames).map(at).collect::<ApiResult<Vec<_>>>()?;
        check_frames(state, &cameras)?;
        Ok(cameras)
    }
}

/// A path along views.
#[derive(Debug)]
struct PathSpec {
    keys: Vec<ViewRequest>,
    frames: Option<u32>,
    closed: bool,
}

impl PathSpec {
    async fn cameras(self, state: &AppState, record: &JobRecord) -> ApiResult<Vec<Camera>> {
        let max = state.limits.frames;
        let frames = count("frames", self.frames, DEFAULT_FRAMES.min(max), max)?;
        if !(1..=MAX_KEYS).contains(&self.keys.len()) {
            return Err(invalid_view(format!(
                "path: {} views are given; 1 to {MAX_KEYS} are possible",
                self.keys.len()
            )));
        }
        let keys = cameras(state, record, specs("path", self.keys)?).await?;
        let size = |camera: &Camera| (camera.intrinsics.width, camera.intrinsics.height);
        if let Some(index) = keys.iter().position(|key| size(key) != size(&keys[0])) {
            let ((width, height), (w, h)) = (size(&keys[0]), size(&keys[index]));
            return Err(invalid_view(format!(
                "path[{index}]: is {w}x{h} where path[0] is {width}x{height}; all must have one size"
            )));
        }
        check_frames(state, &keys)?;
        camera_path::along(&keys, frames as usize, self.closed).map_err(impossible)
    }
}

/// Checks the limits on the size of single pictures.
fn check_frames(state: &AppState, cameras: &[Camera]) -> ApiResult<()> {
    check_sides(cameras, state.limits.view_side)?;
    cameras.first().map_or(Ok(()), |first| check_pixels(&[*first], state.limits.view_pixels))
}
