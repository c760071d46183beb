//! `tcgs view`: one view of a job's scene, rendered by the service.

use std::path::PathBuf;

use image::ImageFormat;
use reqwest::{Method, header::CONTENT_TYPE};
use serde_json::{Map, Value, json};
use tcgs::domain::{JobId, Problem, ProblemType};

use super::{
    ServerFlags,
    connection::{body, unexpected},
    job,
};
use crate::cli::{CliError, Report, files, picture};

/// Arguments of `tcgs view`.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("camera").args(["frame", "pose", "position"]))]
pub(crate) struct Args {
    /// The job: its id, or an address that ends with it
    #[arg(value_parser = job::parse)]
    job: JobId,

    #[command(flatten)]
    server: ServerFlags,

    /// Dataset image whose camera to use [default: the first that is held out]
    #[arg(long, value_name = "NAME")]
    frame: Option<String>,

    /// A camera as a JSON object or a file that holds one, as `tcgs render` takes it
    #[arg(long, value_name = "JSON", conflicts_with_all = ["width", "height"])]
    pose: Option<String>,

    /// Position of the camera
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, requires = "look_at")]
    position: Option<String>,

    /// Point that the camera looks at
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, requires = "position")]
    look_at: Option<String>,

    /// Up direction [default: the z axis]
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true, requires = "position")]
    up: Option<String>,

    /// Horizontal field of view in degrees
    #[arg(long, value_name = "DEGREES", requires = "position")]
    fov: Option<f64>,

    /// Width in pixels
    #[arg(long, value_name = "N")]
    width: Option<u32>,

    /// Height in pixels
    #[arg(long, value_name = "N")]
    height: Option<u32>,

    /// File of a job with --rd-curve [default: its first]
    #[arg(long, value_name = "X")]
    lambda: Option<f64>,

    /// The image to write: .png, .jpg or .webp
    #[arg(short, long, value_name = "OUT.png")]
    output: PathBuf,
}

/// Requests the view and writes it.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let format = match picture::format_of(&args.output)? {
        ImageFormat::Jpeg => "jpeg",
        ImageFormat::WebP => "webp",
        _ => "png",
    };
    files::check_writable(&args.output)?;
    let connection = args.server.connect()?;
    let path = job::path(args.job);
    let image = match &args.pose {
        Some(pose) => {
            let mut view = Map::from_iter([
                ("views".to_owned(), json!([pose_of(pose)?])),
                ("format".to_owned(), json!(format)),
            ]);
            view.extend(args.lambda.map(|lambda| ("lambda".to_owned(), json!(lambda))));
            let view = Value::Object(view).to_string();
            let path = format!("{path}/views");
            let make = async || {
                let request = connection.request(Method::POST, &path)?;
                Ok(request.header(CONTENT_TYPE, "application/json").body(view.clone()))
            };
            super::run(async { image(connection.send_with_retry(make).await?).await })?
        }
        None => {
            let query = serde_urlencoded::to_string(query(args, format)).unwrap_or_default();
            let path = format!("{path}/view?{query}");
            let make = async || connection.request(Method::GET, &path);
            super::run(async { image(connection.send_with_retry(make).await?).await })?
        }
    };
    files::write(&args.output, &image)?;
    Ok(Report::text(format!("wrote {}", args.output.display())))
}

/// The image in a response.
async fn image(response: reqwest::Response) -> Result<Vec<u8>, CliError> {
    let kind = response.headers().get(CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or_default();
    if !kind.starts_with("image/") {
        return Err(unexpected(format!("it sent '{kind}' where an image was to come")));
    }
    body(response).await
}

fn query(args: &Args, format: &str) -> Vec<(&'static str, String)> {
    let texts = [
        ("frame", args.frame.clone()),
        ("position", args.position.clone()),
        ("look_at", args.look_at.clone()),
        ("up", args.up.clone()),
        ("fov", args.fov.map(|fov| fov.to_string())),
        ("width", args.width.map(|width| width.to_string())),
        ("height", args.height.map(|height| height.to_string())),
        ("lambda", args.lambda.map(|lambda| lambda.to_string())),
        ("format", Some(format.to_owned())),
    ];
    texts.into_iter().filter_map(|(name, text)| Some((name, text?))).collect()
}

/// The pose as JSON; the service checks it.
fn pose_of(text: &str) -> Result<Value, CliError> {
    let (source, json) = if text.trim_start().starts_with('{') {
        ("--pose", text.as_bytes().to_vec())
    } else {
        (text, files::read(text.as_ref())?)
    };
    serde_json::from_slice(&json)
        .map_err(|error| Problem::new(ProblemType::ImpossiblePose, error.to_string()).in_file(source).into())
}
