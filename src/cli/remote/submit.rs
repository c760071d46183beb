//! `tcgs submit`: uploads a dataset to a service and creates a job from it.

use std::{collections::BTreeMap, path::PathBuf};

use reqwest::{
    Body, Method,
    header::{CONTENT_LENGTH, CONTENT_TYPE},
};
use serde_json::{Map, Value, json};
use tcgs::domain::{Bytes, MAX_NAME, Metadata, TrainOptions, valid_name};
use uuid::Uuid;

use super::{Connection, ServerFlags, archive::Archive, connection::document, follow::follow, job, upload};
use crate::cli::{CliError, Report, notice::notice, options::TrainFlags, wiring};

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

    /// What to call the job
    #[arg(long, value_parser = name)]
    name: Option<String>,

    /// A label of the job; may be given several times
    #[arg(long, value_name = "KEY=VALUE", value_parser = label)]
    metadata: Vec<(String, String)>,

    /// Priority: jobs of a higher one start first
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    priority: Option<i32>,

    /// Fail the job if it has not succeeded after this many seconds
    #[arg(long, value_name = "SECONDS")]
    deadline: Option<u32>,

    /// Send larger datasets in parts of this size, so that a broken connection costs one part at most
    #[arg(long, value_name = "BYTES", default_value = "16MiB", value_parser = part_size)]
    part_bytes: Bytes,

    /// Leave the check of the dataset to the service, whose version may take what this one refuses
    #[arg(long)]
    unchecked: bool,

    /// Wait for the job to end, and exit with its status
    #[arg(long)]
    wait: bool,

    /// Print the job as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
}

/// Checks the dataset, sends it and, if asked to, waits.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let options = args.options.validated()?;
    let connection = args.server.connect()?;
    let request = request(args, &options)?;
    if !args.unchecked {
        wiring::check_dataset(&args.dataset, &options.reading())?;
    }
    let archive = Archive::open(&args.dataset)?;
    super::run(async {
        let read = options.reading();
        let made = match upload::scene_of(&connection, &archive, args.part_bytes.0, &read).await? {
            Some(scene) => of_scene(&connection, &scene, request).await?,
            None => of_archive(&connection, &archive, &request).await?,
        };
        let (whole, view) = job::read(made)?;
        if !args.wait {
            return Ok(job::created(whole, &view, &args.server));
        }
        notice(format_args!("tcgs: job {}", view.id));
        let (whole, view) = follow(&connection, view.id, &args.server).await?;
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

fn name(text: &str) -> Result<String, String> {
    let error = || format!("a name has 1 to {MAX_NAME} characters, none of them a control character");
    valid_name(text).map(str::to_owned).ok_or_else(error)
}

fn label(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("a label is KEY=VALUE")?;
    Ok((key.to_owned(), value.to_owned()))
}

/// The labels of the job.
fn metadata(labels: &[(String, String)]) -> Result<Metadata, CliError> {
    let mut by_key = BTreeMap::new();
    for (key, value) in labels {
        if by_key.insert(key.clone(), value.clone()).is_some() {
            return Err(CliError::Usage(format!("--metadata: '{key}' is given twice")));
        }
    }
    Metadata::try_from(by_key).map_err(|error| CliError::Usage(format!("--metadata: {error}")))
}

/// The fields of the request for a job; those that are left to the service are absent.
fn request(args: &Args, options: &TrainOptions) -> Result<Map<String, Value>, CliError> {
    let metadata = metadata(&args.metadata)?;
    let Ok(Value::Object(mut fields)) = serde_json::to_value(options) else { return Ok(Map::new()) };
    fields.retain(|_, value| !value.is_null() && value.as_array().is_none_or(|items| !items.is_empty()));
    fields.extend(args.priority.map(|priority| ("priority".to_owned(), priority.into())));
    fields.extend(args.deadline.map(|seconds| ("deadline_s".to_owned(), seconds.into())));
    fields.extend(args.name.as_ref().map(|name| ("name".to_owned(), name.as_str().into())));
    fields.extend((!metadata.is_empty()).then(|| ("metadata".to_owned(), json!(metadata))));
    Ok(fields)
}

/// The same as a query: a list in one parameter, an object in one for each key.
fn query(fields: &Map<String, Value>) -> Vec<(String, String)> {
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let pairs = |(name, value): (&String, &Value)| match value {
        Value::Object(members) => {
            members.iter().map(|(key, value)| (format!("{name}[{key}]"), text(value))).collect()
        }
        Value::Array(items) => vec![(name.clone(), items.iter().map(text).collect::<Vec<_>>().join(","))],
        single => vec![(name.clone(), text(single))],
    };
    fields.iter().flat_map(pairs).collect()
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
            let fields = request(&args, &options).expect("a request");
            let mut read = TrainOptions::default();
            for (name, value) in query(&fields) {
                set(&mut read, &name, &value);
            }
            assert_eq!(read, options);
        }
    }
}
