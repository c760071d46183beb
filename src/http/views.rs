//! Rendered views of a finished job's scene.

use axum::{
    body::Body,
    extract::{Path, RawQuery, State},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use bytes::Bytes;
use serde::Deserialize;
use tokio::runtime::Handle;

use super::{
    artifact::{file_of, take_lambda},
    body::read_json,
    camera::{CameraSpec, invalid_view},
    jobs::find,
    picture::{Format, encode},
    problem::Fault,
    query::Parameters,
    state::AppState,
};
use crate::{
    domain::{Caller, Camera, Digest, NamedCamera, Problem, ViewRequest},
    store::{ArtifactKind, JobRecord},
};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewsBody {
    views: Vec<ViewRequest>,
    #[serde(default)]
    format: Format,
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
) -> Result<Response, Fault> {
    let record = find(&state, &caller, &id).await?;
    let mut parameters = Parameters::parse(query.as_deref())?;
    let format = parameters.take_as("format", "one of png, jpeg, webp")?.unwrap_or_default();
    let lambda = take_lambda(&mut parameters)?;
    let spec = CameraSpec::from_query(&mut parameters)?;
    parameters.finish()?;
    let pictures = render(&state, &record, lambda, vec![spec], format).await?;
    Ok(answer(pictures, format))
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
    let content = read_json(&mut body.into_data_stream(), &headers, state.limits()).await?;
    let ViewsBody { views, format, lambda } =
        serde_json::from_slice(&content).map_err(|error| bad_json(&error))?;
    let most = state.limits().views;
    if !(1..=most).contains(&views.len()) {
        return Err(invalid_view(format!(
            "views: {} views were asked for; 1 to {most} are possible",
            views.len()
        )));
    }
    let specs = views.into_iter().enumerate().map(|(index, view)| CameraSpec::from_body(index, view));
    let pictures = render(&state, &record, lambda, specs.collect::<Result<_, _>>()?, format).await?;
    Ok(answer(pictures, format))
}

fn bad_json(error: &serde_json::Error) -> Fault {
    if error.is_data() {
        return invalid_view(format!("the body is not a view request: {error}"));
    }
    let detail = format!("the body is not JSON: {error}");
    Fault::new(StatusCode::BAD_REQUEST, "malformed-json", "Malformed JSON", detail)
}

async fn render(
    state: &AppState,
    record: &JobRecord,
    lambda: Option<f64>,
    specs: Vec<CameraSpec>,
    format: Format,
) -> Result<Vec<Bytes>, Fault> {
    let file = file_of(record, lambda)?.blob;
    let named = if specs.iter().any(CameraSpec::needs_cameras) {
        dataset_cameras(state, record).await?
    } else {
        Vec::new()
    };
    let cameras =
        specs.into_iter().map(|spec| spec.resolve(&named)).collect::<Result<Vec<Camera>, Fault>>()?;
    check_size(state, &cameras)?;
    let worker = state.clone();
    let runtime = Handle::current();
    let rendered =
        state.renders().run(move || draw(&worker, &runtime, file.digest, &cameras, format)).await?;
    Ok(rendered.map_err(|error| Fault::internal(&error))??)
}

/// Renders and encodes, on a blocking thread.
fn draw(
    state: &AppState,
    runtime: &Handle,
    artifact: Digest,
    cameras: &[Camera],
    format: Format,
) -> Result<Vec<Bytes>, Problem> {
    let services = state.services();
    let load = || {
        let content = runtime.block_on(services.blobs.read(artifact)).map_err(|error| failed(&error))?;
        (services.load)(&content)
    };
    let draw_one = |camera| {
        let image = services.renderer.render(artifact, &load, camera)?;
        encode(&image, format).map_err(|error| failed(&error))
    };
    cameras.iter().map(draw_one).collect()
}

fn failed(error: &(dyn std::error::Error + 'static)) -> Problem {
    tracing::error!(error, "a view cannot be made: {error}");
    super::problem::internal()
}

async fn dataset_cameras(state: &AppState, record: &JobRecord) -> Result<Vec<NamedCamera>, Fault> {
    let fault = || Fault::no_file_yet(record.job.id, record.job.state.name());
    let blob = record.artifact(ArtifactKind::Cameras).ok_or_else(fault)?;
    let content = state.blobs().read(blob.digest).await?;
    serde_json::from_slice(&content).map_err(|error| Fault::internal(&error))
}

fn check_size(state: &AppState, cameras: &[Camera]) -> Result<(), Fault> {
    let limits = state.limits();
    let mut pixels = 0_u64;
    for Camera { intrinsics, .. } in cameras {
        let (width, height) = (intrinsics.width, intrinsics.height);
        if width.max(height) > limits.view_side {
            return Err(too_many_pixels(format!(
                "{width}x{height} is more than {} pixels a side",
                limits.view_side
            )));
        }
        pixels += u64::from(width) * u64::from(height);
    }
    if pixels > limits.view_pixels {
        return Err(too_many_pixels(format!(
            "{pixels} pixels in all are more than the {} that one request may ask for",
            limits.view_pixels
        )));
    }
    Ok(())
}

fn too_many_pixels(detail: String) -> Fault {
    Fault::new(StatusCode::UNPROCESSABLE_ENTITY, "view-too-large", "View too large", detail)
}

/// One picture as itself, more as the parts of a multipart body, in the order asked for.
fn answer(mut pictures: Vec<Bytes>, format: Format) -> Response {
    let caching = (header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if pictures.len() == 1 {
        let media_type = HeaderValue::from_static(format.media_type());
        return ([caching, (header::CONTENT_TYPE, media_type)], pictures.remove(0)).into_response();
    }
    // The boundary need only be absent from the parts; one that hashes them cannot be in them by accident.
    let digests: Vec<u8> =
        pictures.iter().flat_map(|picture| Digest::of(picture).as_bytes().to_owned()).collect();
    let boundary = Digest::of(&digests).to_string();
    let mut body = Vec::with_capacity(pictures.iter().map(|picture| picture.len() + 256).sum());
    for (index, picture) in pictures.iter().enumerate() {
        let head = format!(
            "--{boundary}\r\nContent-Type: {}\r\nContent-Length: {}\r\nContent-Disposition: inline; filename=\"{index}.{}\"\r\n\r\n",
            format.media_type(),
            picture.len(),
            format.extension(),
        );
        body.extend_from_slice(head.as_bytes());
        body.extend_from_slice(picture);
        body.extend_from_slice(b"\r\n");
    }
    body.extend_from_slice(format!("--{boundary}--\r\n").as_bytes());
    let media_type = HeaderValue::try_from(format!("multipart/mixed; boundary={boundary}"))
        .unwrap_or(HeaderValue::from_static("multipart/mixed"));
    ([caching, (header::CONTENT_TYPE, media_type)], body).into_response()
}
