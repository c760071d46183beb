//! `tcgs submit`: a dataset to a service, as a job.

use std::{
    fs::File,
    io::Seek as _,
    path::{Path, PathBuf},
};

use reqwest::{
    Body, Method,
    header::{CONTENT_LENGTH, CONTENT_TYPE},
};
use serde_json::Value;
use tcgs::domain::{Problem, TrainOptions};
use uuid::Uuid;

use super::{Connection, ServerFlags, connection::document, follow::follow, job};
use crate::cli::{Failure, Report, train::Options, wiring};

/// Arguments of `tcgs submit`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder or zip: Blender, nerfstudio or COLMAP layout; a folder is packed on the way
    dataset: PathBuf,

    #[command(flatten)]
    server: ServerFlags,

    #[command(flatten)]
    options: Options,

    /// Jobs of higher priority go first
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    priority: Option<i32>,

    /// Give the job up, finished or not, after so many seconds
    #[arg(long, value_name = "SECONDS")]
    deadline: Option<u32>,

    /// Wait until the job has ended; its failure is then the command's
    #[arg(long)]
    wait: bool,

    /// Print the job as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
}

/// Sends the dataset and, if asked to, waits.
pub(crate) fn run(args: &Args) -> Result<Report, Failure> {
    let options = args.options.train_options()?;
    let connection = args.server.connect()?;
    let mut query = query(&options);
    query.extend(args.priority.map(|priority| ("priority".to_owned(), priority.to_string())));
    query.extend(args.deadline.map(|seconds| ("deadline_s".to_owned(), seconds.to_string())));
    let archive = archive(&args.dataset)?;
    super::run(async {
        let (whole, view) = job::read(send(&connection, &archive, &query).await?)?;
        if !args.wait {
            let text = format!("job {}\nwatch     tcgs watch {}", view.id, view.id);
            return Ok(Report { text, json: whole });
        }
        eprintln!("tcgs: job {}", view.id);
        let (whole, view) = follow(&connection, view.id).await?;
        job::conclude(whole, view)
    })
}

/// The options that were chosen, as the query has them.
fn query(options: &TrainOptions) -> Vec<(String, String)> {
    let Ok(Value::Object(options)) = serde_json::to_value(options) else { return Vec::new() };
    let text = |value: &Value| match value {
        Value::Null => None,
        Value::String(text) => Some(text.clone()),
        Value::Array(items) if items.is_empty() => None,
        Value::Array(items) => {
            let item = |item: &Value| item.as_str().map_or_else(|| item.to_string(), str::to_owned);
            Some(items.iter().map(item).collect::<Vec<_>>().join(","))
        }
        other => Some(other.to_string()),
    };
    options.iter().filter_map(|(name, value)| Some((name.clone(), text(value)?))).collect()
}

/// The zip to send: the one that is named, or a temporary one of the folder that is named.
fn archive(dataset: &Path) -> Result<File, Failure> {
    let unreadable = |fault| Failure::unreadable(dataset, &fault);
    if !dataset.is_dir() {
        return File::open(dataset).map_err(unreadable);
    }
    let no_room = |fault: std::io::Error| {
        Problem::new(507, "unwritable-output", "The output cannot be written", fault.to_string())
            .in_file(std::env::temp_dir().display().to_string())
    };
    let mut archive = tempfile::tempfile().map_err(no_room)?;
    wiring::pack(dataset, &mut archive)?;
    archive.rewind().map_err(no_room)?;
    Ok(archive)
}

/// Creates the job. A key of its own lets the request be repeated without making a second one.
async fn send(connection: &Connection, archive: &File, query: &[(String, String)]) -> Result<Value, Failure> {
    let key = Uuid::now_v7().to_string();
    let spent = |fault: std::io::Error| {
        Failure::from(Problem::new(422, "unreadable-input", "The input cannot be read", fault.to_string()))
    };
    let bytes = archive.metadata().map_err(spent)?.len();
    let path = format!("/v1/jobs?{}", serde_urlencoded::to_string(query).unwrap_or_default());
    let make = async || {
        let mut again = archive.try_clone().map_err(spent)?;
        again.rewind().map_err(spent)?;
        let request = connection.request(Method::POST, &path)?;
        Ok(request
            .header(CONTENT_TYPE, "application/zip")
            .header(CONTENT_LENGTH, bytes)
            .header("idempotency-key", &key)
            .body(Body::from(tokio::fs::File::from_std(again))))
    };
    document(connection.insist(make).await?).await
}

#[cfg(test)]
mod tests {
    use super::*;

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
            ("rd_curve", "0.001,0.004"),
        ];
        for (name, value) in settings {
            chosen.set(name, value).expect("an option");
        }
        for options in [TrainOptions::default(), chosen] {
            let mut read = TrainOptions::default();
            for (name, value) in query(&options) {
                read.set(&name, &value).expect("an option");
            }
            assert_eq!(read, options);
        }
    }
}
