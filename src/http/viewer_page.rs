//! `GET /v1/jobs/{id}/viewer`: a page that decodes and draws a job's scene in the browser, and the module that it does that with.

use std::sync::LazyLock;

use axum::{
    extract::State,
    http::{HeaderMap, HeaderValue, header},
    response::{IntoResponse as _, Response},
};

use super::{
    auth::shared_link::OptionalLink,
    files::{document, file_of, take_lambda},
    html,
    jobs::OwnedJob,
    problem::{Answer as _, ApiResult, ProblemResponse},
    request::{Etag, Parameters, accepts, not_modified},
    state::AppState,
};
use crate::{
    domain::{Digest, HeldOut, NamedCamera, Orbit, ProblemType, SceneFormat, Split},
    store::{ArtifactKind, JobRecord, SceneArtifact},
    viewer_page::{Assets, FileLink, Links, Stop, ViewerScene, assets, served, served_policy},
};

/// From the page's folder to the service's first, and that from the page of a link, which lies two folders deeper.
const ROOT: &str = "../../..";
const ROOT_OF_LINK: &str = "../../../../..";

static POLICY: LazyLock<Option<HeaderValue>> = LazyLock::new(|| HeaderValue::try_from(served_policy()).ok());

/// Differs between programs with other pages or modules.
static BUILD: LazyLock<String> = LazyLock::new(|| {
    let Assets { module, worker } = assets().unwrap_or(Assets { module: &[], worker: "" });
    let page = [served_policy().as_bytes(), worker.as_bytes(), module].concat();
    Digest::of(&page).to_string()[..16].to_owned()
});

/// `GET /v1/jobs/{id}/viewer`.
pub(super) async fn page(
    State(state): State<AppState>,
    OwnedJob(record): OwnedJob,
    link: OptionalLink,
    mut parameters: Parameters,
    headers: HeaderMap,
) -> ApiResult {
    let lambda = take_lambda(&mut parameters)?;
    parameters.finish()?;
    if !accepts(&headers, "text/html") {
        return Err(ProblemType::NotAcceptable.because("this page is served as text/html"));
    }
    let file = file_of(&record, lambda)?;
    let etag =
        Etag::new(format!("{}-{}-{}", record.job.version, *BUILD, &file.blob.digest.to_string()[..16]));
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    let cameras: Vec<NamedCamera> =
        document(&state, &record, ArtifactKind::Cameras).await?.unwrap_or_default();
    let held_out: Option<HeldOut> = document(&state, &record, ArtifactKind::HeldOut).await?;
    let scene = ViewerScene {
        links: Some(links(&file, &link)),
        ..scene_of(&record, file.lambda, &cameras, held_out)?
    };
    let mut response = html::page(served(&scene), POLICY.clone())?;
    response.headers_mut().insert(header::ETAG, etag.value());
    Ok(response)
}

/// `GET /viewer/worker.js`.
pub(super) async fn worker(headers: HeaderMap) -> ApiResult {
    let Assets { worker, .. } = built()?;
    let etag = Etag::new(format!("{}-worker", *BUILD));
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    let mut response = worker.into_response();
    // What the worker may do: compile its module.
    let policy = HeaderValue::from_static("default-src 'none'; script-src 'wasm-unsafe-eval'");
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    Ok(asset(response, "text/javascript; charset=utf-8", &etag))
}

/// `GET /viewer/module.wasm`, as it is stored for clients that accept gzip.
pub(super) async fn module(headers: HeaderMap) -> ApiResult {
    let assets = built()?;
    let is_packed = accepts_gzip(&headers);
    let etag = Etag::new(format!("{}-module{}", *BUILD, if is_packed { "-gzip" } else { "" }));
    if etag.is_in_if_none_match(&headers) {
        return Ok(not_modified(&etag));
    }
    let mut response = if is_packed {
        let mut response = assets.module.into_response();
        response.headers_mut().insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
        response
    } else {
        assets.unpacked().map_err(|error| ProblemResponse::internal(&error))?.into_response()
    };
    response.headers_mut().insert(header::VARY, HeaderValue::from_static("accept-encoding"));
    Ok(asset(response, "application/wasm", &etag))
}

fn asset(mut response: Response, media_type: &'static str, etag: &Etag) -> Response {
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("public, no-cache"));
    headers.insert(header::ETAG, etag.value());
    response
}

fn built() -> ApiResult<Assets> {
    assets().ok_or_else(|| {
        ProblemType::NotFound.because(
            "this program was built without the viewer for browsers; scripts/web.sh builds it before cargo does",
        )
    })
}

/// Whether a client takes gzip: it names it, and not with weight 0.
fn accepts_gzip(headers: &HeaderMap) -> bool {
    let values = headers.get_all(header::ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
    values.flat_map(|value| value.split(',')).any(|coding| {
        let mut parts = coding.split(';').map(str::trim);
        let is_gzip = parts.next().is_some_and(|name| name.eq_ignore_ascii_case("gzip"));
        let weight = parts.find_map(|part| part.strip_prefix("q=")).map_or(Ok(1.0), str::parse::<f32>);
        is_gzip && weight.is_ok_and(|weight| weight > 0.0)
    })
}

/// What the page shows of a job.
fn scene_of(
    record: &JobRecord,
    lambda: Option<f64>,
    cameras: &[NamedCamera],
    held_out: Option<HeldOut>,
) -> ApiResult<ViewerScene> {
    let views = held_out.map(|sheet| sheet.views).unwrap_or_default();
    let photograph =
        |name: &str| views.iter().find(|view| view.score.name == name).map(|view| view.photograph.clone());
    let stop = |named: &NamedCamera| Stop::new(named.name.clone(), &named.camera, photograph(&named.name));
    // Held-out cameras first: those may have photographs.
    let of = |split: Split| cameras.iter().filter(move |named| named.split == split).map(stop);
    let stops: Vec<Stop> = of(Split::Test).chain(of(Split::Train)).collect();
    let all: Vec<_> = cameras.iter().map(|named| named.camera).collect();
    let Some(orbit) = Orbit::around(&all) else {
        return Err(
            ProblemType::NotFound.because("this job kept no cameras, and the page needs one to begin with")
        );
    };
    let name = record.name.clone().unwrap_or_else(|| format!("Scene {}", record.job.id));
    let title = lambda.map_or_else(|| name.clone(), |lambda| format!("{name}, λ = {lambda}"));
    Ok(ViewerScene { title, stops, center: orbit.center, up: orbit.up, links: None })
}

/// Where the page finds the rest.
fn links(file: &SceneArtifact, link: &OptionalLink) -> Links {
    let SceneArtifact { format, lambda, blob } = *file;
    let root = if link.prefix.is_some() { ROOT_OF_LINK } else { ROOT };
    let query = match &link.target {
        // Such a link opens no other query.
        Some(target) => target.split_once('?').map_or_else(String::new, |(_, query)| format!("?{query}")),
        // One of several files is asked for by its weight.
        None => lambda.map_or_else(String::new, |lambda| format!("?lambda={lambda}")),
    };
    let of_file = |name: &str| format!("{name}{query}");
    let why = match (format, assets()) {
        (SceneFormat::Tcgs, Some(_)) => None,
        (SceneFormat::Tcgs, None) => Some("This service was built without the viewer for browsers."),
        _ => Some("Browsers draw .tcgs files only."),
    };
    Links {
        file: why.is_none().then(|| FileLink { href: of_file("artifact"), bytes: blob.bytes }),
        why: why.map(str::to_owned),
        module: format!("{root}/viewer/module.wasm"),
        worker: format!("{root}/viewer/worker.js"),
        view: of_file("view"),
        report: link.target.is_none().then(|| "report".to_owned()),
    }
}
