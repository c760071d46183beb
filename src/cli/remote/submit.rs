//! `tcgs submit`: uploads a dataset to a service and creates a job from it.

use std::path::PathBuf;

use reqwest::{
    Body, Method,
    header::{CONTENT_LENGTH, CONTENT_TYPE},
};
use serde_json::{Map, Value};
use tcgs::domain::{Bytes, TrainOptions};
use uuid::Uuid;

use super::{Connection, ServerFlags, archive::Archive, connection::document, follow::follow, job, upload};
use crate::cli::{CliError, Report, notice::notice, options::TrainFlags};

/// Largest part; one is held in memory.
const MAX_PART_BYTES: u64 = 256 << 20;

/// Arguments of `tcgs submit`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder or zip: Blender, nerfstudio or COLMAP layout; a folder is zipped first
    dataset: PathBuf,

    #[command(flatten)]
    server: ServerFlags,

    #[command(flatten)]
    options: TrainFlags,

    /// Priority: jobs of a higher one start first
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    priority: Option<i32>,

    /// Fail the job if it has not succeeded after this many seconds
    #[arg(long, value_name = "SECONDS")]
    deadline: Option<u32>,

    /// Send larger datasets in parts of this size, so that a broken connection costs one part at most
    #[arg(long, value_name = "BYTES", default_value = "16MiB", value_parser = part_size)]
    part_bytes: Bytes,

    /// Wait for the job to end, and exit with its status
    #[arg(long)]
    wait: bool,

    /// Print the job as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
}

/// Sends the dataset and, if asked to, waits.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let options = args.options.validated()?;
    let connection = args.server.connect()?;
    let request = request(args, &options);
    let archive = Archive::open(&args.dataset)?;
    super::run(async {
        let made = match upload::scene_of(&connection, &archive, args.part_bytes.0).await? {
            Some(scene) => of_scene(&connection, &scene, request).await?,
            None => of_archive(&connection, &archive, &request).await?,
        };
        let (whole, view) = job::read(made)?;
        if !args.wait {
            let watch = args.server.command_line(&format!("watch {}", view.id));
            let text = format!("job {}\nwatch     {watch}", view.id);
            return Ok(Report { text, json: whole });
        }
        notice(format_args!("tcgs: job {}", view.id));
        let (whole, view) = follow(&connection, view.id).await?;
        job::conclude(whole, view, &args.server)
    })
}

fn part_size(text: &str) -> Result<Bytes, String> {
    let bytes: Bytes = text.parse()?;
    match bytes.0 {
        1..=MAX_PART_BYTES => Ok(bytes),
        _ => Err(format!("a part has 1 byte to {} MiB", MAX_PART_BYTES >> 20)),
    }
}

/// The fields of the request for a job; those that are left to the service are absent.
fn request(args: &Args, options: &TrainOptions) -> Map<String, Value> {
    let Ok(Value::Object(mut fields)) = serde_json::to_value(options) else { return Map::new() };
    fields.retain(|_, value| !value.is_null() && value.as_array().is_none_or(|items| !items.is_empty()));
    fields.extend(args.priority.map(|priority| ("priority".to_owned(), priority.into())));
    fields.extend(args.deadline.map(|seconds| ("deadline_s".to_owned(), seconds.into())));
    fields
}

/// The same as a query.
fn query(fields: &Map<String, Value>) -> Vec<(&str, String)> {
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let list = |value: &Value| match value {
        Value::Array(items) => items.iter().map(text).collect::<Vec<_>>().join(","),
        single => text(single),
    };
    fields.iter().map(|(name, value)| (&**name, list(value))).collect()
}

/// Creates a job from the archive in one request. Its idempotency key makes it safe to repeat.
async fn of_archive(
    connection: &Connection,
    archive: &Archive,
    fields: &Map<String, Value>,
) -> Result<Value, CliError> {
    let key = Uuid::now_v7().to_string();
    let path = format!("/v1/jobs?{}", serde_urlencoded::to_string(query(fields)).unwrap_or_default());
    let make = async || {
        let body = Body::from(tokio::fs::File::from_std(archive.at(0)?));
        let request = connection.request(Method::POST, &path)?.header("idempotency-key", &key);
        Ok(request.header(CONTENT_TYPE, "application/zip").header(CONTENT_LENGTH, archive.bytes).body(body))
    };
    document(connection.send_with_retry(make).await?).await
}

/// Creates a job from a dataset that the service has.
async fn of_scene(
    connection: &Connection,
    scene: &str,
    mut fields: Map<String, Value>,
) -> Result<Value, CliError> {
    fields.insert("scene_id".to_owned(), scene.into());
    document(connection.post("/v1/jobs", &Value::Object(fields)).await?).await
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use tcgs::domain::TrainOption;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn a_query_gives_back_the_options_that_it_was_made_of() {
        let mut chosen = TrainOptions::default();
        let settings = [
            ("preset", "standard"),
            ("iterations", "70"),
            ("seed", "3"),
            ("background", "white"),
            ("voxel", "0.25"),
            ("without", "masks,knn"),
            ("with", "plane-compression"),
            ("rd_curve", "0.001,0.004"),
        ];
        let set = |options: &mut TrainOptions, name: &str, value: &str| {
            TrainOption::named(name).expect("an option").set(options, value).expect("a value");
        };
        for (name, value) in settings {
            set(&mut chosen, name, value);
        }
        for options in [TrainOptions::default(), chosen] {
            let line = ["submit", "dataset"];
            let args = Line::try_parse_from(line).expect("parses").args;
            let fields = request(&args, &options);
            let mut read = TrainOptions::default();
            for (name, value) in query(&fields) {
                set(&mut read, name, &value);
            }
            assert_eq!(read, options);
        }
    }
}
