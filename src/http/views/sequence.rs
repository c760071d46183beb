//! Streams and animations: around the scene, or along a path of views.

use std::time::Duration;

use axum::{
    body::Body,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderValue, header},
    response::Response,
};
use serde::Deserialize;

use super::{
    bad_field, cameras, check_pixels, check_sides, dataset_cameras,
    film::{Ends, Film, Parts, Wrapping},
    keep_a_day,
    key::Shot,
    queue::Visit,
    read, shots_of_any_size, specs, take_kind,
};
use crate::{
    domain::{Caller, Camera, Intrinsics, Orbit, Split, ViewRequest, camera_path},
    http::{
        artifact::take_lambda,
        camera::{impossible, impossible_view, invalid_view, scaled, side},
        etag::not_modified,
        jobs::find,
        picture::{Format, Output, PictureKind},
        problem::Fault,
        query::Parameters,
        state::AppState,
    },
    store::JobRecord,
};

const DEFAULT_FRAMES: u32 = 72;
const DEFAULT_RATE: u32 = 12;
const MAX_RATE: u32 = 60;
const MAX_ROUNDS: u32 = 1000;
/// Keys of a path.
const MAX_KEYS: usize = 64;
/// Width of an orbit's pictures where the dataset's are wider and nothing is asked for.
const USUAL_WIDTH: u32 = 640;

/// `GET /v1/jobs/{id}/stream`.
pub(in crate::http) async fn stream(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let mut parameters = Parameters::parse(query.as_deref())?;
    let rounds = parameters.take_count("orbit", 1, MAX_ROUNDS)?;
    let rate = parameters.take_count("fps", DEFAULT_RATE, MAX_RATE)?;
    let kind = take_kind(&mut parameters, Format::Jpeg)?;
    let lambda = take_lambda(&mut parameters)?;
    let orbit = OrbitSpec::take(&mut parameters, state.limits().frames)?;
    parameters.finish()?;
    let cameras = orbit.cameras(&state, &record).await?;
    streamed(&state, &caller, shots_of_any_size(&record, lambda, &cameras, kind)?, rounds, rate).await
}

/// `POST /v1/jobs/{id}/stream`.
pub(in crate::http) async fn stream_path(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct StreamBody {
        path: Vec<ViewRequest>,
        frames: Option<u32>,
        #[serde(default)]
        closed: bool,
        rounds: Option<u32>,
        fps: Option<u32>,
        output: Option<Output>,
        format: Option<Format>,
        quality: Option<u8>,
        lambda: Option<f64>,
    }
    let record = find(&state, &caller, &id).await?;
    let body: StreamBody = read(&state, &headers, body).await?;
    let kind = PictureKind::new(body.output, body.format, body.quality, Format::Jpeg).map_err(bad_field)?;
    let path = PathSpec { keys: body.path, frames: body.frames, closed: body.closed };
    let rate = count("fps", body.fps, DEFAULT_RATE, MAX_RATE)?;
    let rounds = count("rounds", body.rounds, 1, MAX_ROUNDS)?;
    let cameras = path.cameras(&state, &record).await?;
    streamed(&state, &caller, shots_of_any_size(&record, body.lambda, &cameras, kind)?, rounds, rate).await
}

/// `GET /v1/jobs/{id}/animation`.
pub(in crate::http) async fn animation(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
    headers: HeaderMap,
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let mut parameters = Parameters::parse(query.as_deref())?;
    let rate = parameters.take_count("fps", DEFAULT_RATE, MAX_RATE)?;
    let lambda = take_lambda(&mut parameters)?;
    let orbit = OrbitSpec::take(&mut parameters, state.limits().frames)?;
    parameters.finish()?;
    let film = animated(&state, &record, lambda, &orbit.cameras(&state, &record).await?)?;
    let etag = film.key(&state, &format!("apng at {rate}")).etag();
    let mut response = if etag.is_in_if_none_match(&headers) {
        not_modified(&etag)
    } else {
        shown(&state, &caller, film, rate).await?
    };
    keep_a_day(&mut response, &etag);
    Ok(response)
}

/// `POST /v1/jobs/{id}/animation`.
pub(in crate::http) async fn animation_path(
    State(state): State<AppState>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Fault> {
    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct AnimationBody {
        path: Vec<ViewRequest>,
        frames: Option<u32>,
        #[serde(default)]
        closed: bool,
        fps: Option<u32>,
        lambda: Option<f64>,
    }
    let record = find(&state, &caller, &id).await?;
    let body: AnimationBody = read(&state, &headers, body).await?;
    let path = PathSpec { keys: body.path, frames: body.frames, closed: body.closed };
    let rate = count("fps", body.fps, DEFAULT_RATE, MAX_RATE)?;
    let film = animated(&state, &record, body.lambda, &path.cameras(&state, &record).await?)?;
    let mut response = shown(&state, &caller, film, rate).await?;
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(response)
}

/// Plays the shots `rounds` times, so many a second.
async fn streamed(
    state: &AppState,
    caller: &Caller,
    shots: Vec<Shot>,
    rounds: u32,
    rate: u32,
) -> Result<Response, Fault> {
    let every = Some(Duration::from_secs(1) / rate);
    let film = Film { shots, rounds, every, ends: Ends::With(caller.key) };
    let place = state.studio().queue.enter(caller.key, Visit::Stream)?;
    let mut response = film.answer(state, place, Wrapping::Parts(Parts::Replace)).await?;
    let headers = response.headers_mut();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    // Proxies that know the header pass each picture on at once.
    headers.insert("x-accel-buffering", HeaderValue::from_static("no"));
    Ok(response)
}

fn animated(
    state: &AppState,
    record: &JobRecord,
    lambda: Option<f64>,
    cameras: &[Camera],
) -> Result<Film, Fault> {
    check_pixels(cameras, state.limits().animation_pixels)?;
    let kind = PictureKind { output: Output::Color, format: Format::Png, quality: 0 };
    let shots = shots_of_any_size(record, lambda, cameras, kind)?;
    Ok(Film { shots, rounds: 1, every: None, ends: Ends::WhenDone })
}

async fn shown(state: &AppState, caller: &Caller, film: Film, rate: u32) -> Result<Response, Fault> {
    let place = state.studio().queue.enter(caller.key, Visit::Request(film.shots.len()))?;
    let frames_per_second = u16::try_from(rate).unwrap_or(u16::MAX);
    film.answer(state, place, Wrapping::Apng { frames_per_second }).await
}

/// A number of a JSON body from 1 to `most`, or `usual`.
fn count(name: &str, given: Option<u32>, usual: u32, most: u32) -> Result<u32, Fault> {
    let count = given.unwrap_or(usual);
    if !(1..=most).contains(&count) {
        return Err(invalid_view(format!("{name}: {count} is outside 1..={most}")));
    }
    Ok(count)
}

/// One round about the scene.
#[derive(Debug)]
struct OrbitSpec {
    frames: u32,
    radius: f64,
    elevation: Option<f64>,
    width: Option<u32>,
    height: Option<u32>,
}

impl OrbitSpec {
    fn take(parameters: &mut Parameters, most_frames: u32) -> Result<Self, Fault> {
        let frames = parameters.take_count("frames", DEFAULT_FRAMES.min(most_frames), most_frames)?;
        let radius = parameters.take_as("radius", "a number")?.unwrap_or(1.0);
        if !(0.05..=20.0).contains(&radius) {
            return Err(Fault::parameter("radius", format!("{radius} is outside 0.05..=20")));
        }
        let elevation: Option<f64> = parameters.take_as("elevation", "a number of degrees")?;
        if let Some(elevation) = elevation.filter(|elevation| !(-89.0..=89.0).contains(elevation)) {
            return Err(Fault::parameter("elevation", format!("{elevation} is outside -89..=89 degrees")));
        }
        let (width, height) = (side(parameters, "width")?, side(parameters, "height")?);
        Ok(Self { frames, radius, elevation, width, height })
    }

    /// Around what the training cameras look at, as wide as the first of them sees.
    async fn cameras(&self, state: &AppState, record: &JobRecord) -> Result<Vec<Camera>, Fault> {
        let named = dataset_cameras(state, record).await?;
        let training: Vec<Camera> =
            named.iter().filter(|camera| camera.split == Split::Train).map(|camera| camera.camera).collect();
        let no_cameras =
            || impossible_view("the dataset has no training cameras to go around with".to_owned());
        let orbit = Orbit::around(&training).ok_or_else(no_cameras)?;
        let orbit = self.elevation.map_or(orbit, |degrees| orbit.at_elevation(degrees)).scaled(self.radius);
        let seen = training.first().ok_or_else(no_cameras)?.intrinsics;
        let width = match (self.width, self.height) {
            (None, None) => Some(seen.width.min(USUAL_WIDTH)),
            (width, _) => width,
        };
        let scaled = scaled(seen, width, self.height).map_err(impossible)?;
        let middle = |side: u32| f64::from(side) / 2.0;
        let intrinsics = Intrinsics { cx: middle(scaled.width), cy: middle(scaled.height), ..scaled };
        let at = |frame: u32| {
            let pose = orbit.pose(f64::from(frame) / f64::from(self.frames)).map_err(impossible)?;
            Camera::new(intrinsics, pose).map_err(impossible)
        };
        let cameras = (0..self.frames).map(at).collect::<Result<Vec<_>, Fault>>()?;
        check_frames(state, &cameras)?;
        Ok(cameras)
    }
}

/// A way along views.
#[derive(Debug)]
struct PathSpec {
    keys: Vec<ViewRequest>,
    frames: Option<u32>,
    closed: bool,
}

impl PathSpec {
    async fn cameras(self, state: &AppState, record: &JobRecord) -> Result<Vec<Camera>, Fault> {
        let most = state.limits().frames;
        let frames = count("frames", self.frames, DEFAULT_FRAMES.min(most), most)?;
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

/// Whether each picture by itself may be asked for.
fn check_frames(state: &AppState, cameras: &[Camera]) -> Result<(), Fault> {
    check_sides(state, cameras)?;
    cameras.first().map_or(Ok(()), |first| check_pixels(&[*first], state.limits().view_pixels))
}
