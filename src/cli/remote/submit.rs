//! `tcgs submit`: a dataset to a service, as a job.

use std::{
    fs::File,
    io::{Read as _, Seek as _, SeekFrom},
    path::{Path, PathBuf},
};

use reqwest::{
    Body, Method,
    header::{CONTENT_LENGTH, CONTENT_TYPE},
};
use serde_json::{Map, Value};
use tcgs::domain::{Bytes, TrainOptions};
use uuid::Uuid;

use super::{Connection, ServerFlags, connection::document, follow::follow, job, upload};
use crate::cli::{Failure, Report, train::Options, wiring};

/// Largest part; one is held in memory.
const MOST_PART_BYTES: u64 = 256 << 20;

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

    /// Send a dataset larger than this in parts of this size, so that a broken connection costs no more than a part
    #[arg(long, value_name = "BYTES", default_value = "16MiB", value_parser = part_size)]
    part_bytes: Bytes,

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
    let wish = wish(args, &options);
    let archive = Archive::open(&args.dataset)?;
    super::run(async {
        let made = match upload::scene_of(&connection, &archive, args.part_bytes.0).await? {
            Some(scene) => of_scene(&connection, &scene, wish).await?,
            None => of_archive(&connection, &archive, &wish).await?,
        };
        let (whole, view) = job::read(made)?;
        if !args.wait {
            let text = format!("job {}\nwatch     tcgs watch {}", view.id, view.id);
            return Ok(Report { text, json: whole });
        }
        eprintln!("tcgs: job {}", view.id);
        let (whole, view) = follow(&connection, view.id).await?;
        job::conclude(whole, view)
    })
}

fn part_size(text: &str) -> Result<Bytes, String> {
    let bytes: Bytes = text.parse()?;
    match bytes.0 {
        1..=MOST_PART_BYTES => Ok(bytes),
        _ => Err(format!("a part has 1 byte to {} MiB", MOST_PART_BYTES >> 20)),
    }
}

/// What is asked for, by its names in the API; what is left to the service is not there.
fn wish(args: &Args, options: &TrainOptions) -> Map<String, Value> {
    let Ok(Value::Object(mut wish)) = serde_json::to_value(options) else { return Map::new() };
    wish.retain(|_, value| !value.is_null() && value.as_array().is_none_or(|items| !items.is_empty()));
    wish.extend(args.priority.map(|priority| ("priority".to_owned(), priority.into())));
    wish.extend(args.deadline.map(|seconds| ("deadline_s".to_owned(), seconds.into())));
    wish
}

/// The same as a query.
fn query(wish: &Map<String, Value>) -> Vec<(&str, String)> {
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let list = |value: &Value| match value {
        Value::Array(items) => items.iter().map(text).collect::<Vec<_>>().join(","),
        single => text(single),
    };
    wish.iter().map(|(name, value)| (&**name, list(value))).collect()
}

/// The zip to send: the one that is named, or a temporary one of the folder that is named.
pub(super) struct Archive {
    file: File,
    pub(super) bytes: u64,
    name: PathBuf,
}

impl Archive {
    fn open(dataset: &Path) -> Result<Self, Failure> {
        let unreadable = |fault| Failure::unreadable(dataset, &fault);
        let file = if dataset.is_dir() {
            let mut file =
                tempfile::tempfile().map_err(|fault| Failure::unwritable(&std::env::temp_dir(), &fault))?;
            wiring::pack(dataset, &mut file)?;
            file
        } else {
            File::open(dataset).map_err(unreadable)?
        };
        let bytes = file.metadata().map_err(unreadable)?.len();
        Ok(Self { file, bytes, name: dataset.to_owned() })
    }

    /// The archive from its byte `from` on.
    pub(super) fn at(&self, from: u64) -> Result<File, Failure> {
        let unreadable = |fault| Failure::unreadable(&self.name, &fault);
        let mut file = self.file.try_clone().map_err(unreadable)?;
        file.seek(SeekFrom::Start(from)).map_err(unreadable)?;
        Ok(file)
    }

    /// So many bytes from `from` on.
    pub(super) fn part(&self, from: u64, bytes: u64) -> Result<Vec<u8>, Failure> {
        let mut part = Vec::new();
        let read = self.at(from)?.take(bytes).read_to_end(&mut part);
        read.map_err(|fault| Failure::unreadable(&self.name, &fault))?;
        Ok(part)
    }
}

/// Makes a job of the archive in one request. A key of its own lets the request be repeated without making a second job.
async fn of_archive(
    connection: &Connection,
    archive: &Archive,
    wish: &Map<String, Value>,
) -> Result<Value, Failure> {
    let key = Uuid::now_v7().to_string();
    let path = format!("/v1/jobs?{}", serde_urlencoded::to_string(query(wish)).unwrap_or_default());
    let make = async || {
        let body = Body::from(tokio::fs::File::from_std(archive.at(0)?));
        let request = connection.request(Method::POST, &path)?.header("idempotency-key", &key);
        Ok(request.header(CONTENT_TYPE, "application/zip").header(CONTENT_LENGTH, archive.bytes).body(body))
    };
    document(connection.insist(make).await?).await
}

/// Makes a job of a scene that the service has.
async fn of_scene(connection: &Connection, scene: &str, wish: Map<String, Value>) -> Result<Value, Failure> {
    let mut wish = wish;
    wish.insert("scene_id".to_owned(), scene.into());
    document(connection.post("/v1/jobs", &Value::Object(wish)).await?).await
}

#[cfg(test)]
mod tests {
    use clap::Parser;

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
        for (name, value) in settings {
            chosen.set(name, value).expect("an option");
        }
        for options in [TrainOptions::default(), chosen] {
            let line = ["submit", "dataset"];
            let args = Line::try_parse_from(line).expect("parses").args;
            let wish = wish(&args, &options);
            let mut read = TrainOptions::default();
            for (name, value) in query(&wish) {
                read.set(name, &value).expect("an option");
            }
            assert_eq!(read, options);
        }
    }
}
