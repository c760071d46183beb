//! `tcgs fetch`: a job's file from a service.
//!
//! The file gets its name when it is complete and has the digest that the service states. Until then it is stored next to it under a name
//! with the digest, so that a later call resumes the download and never mixes the bytes of two files.

use std::{
    fs::{File, OpenOptions},
    io::{self, Read as _, Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
    time::Duration,
};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use indicatif::ProgressBar;
use reqwest::{
    Method, Response, StatusCode,
    header::{CONTENT_RANGE, IF_RANGE, RANGE},
};
use serde_json::json;
use sha2::{Digest as _, Sha256};
use tcgs::domain::{Digest, JobId, Problem, ProblemType};

use super::{
    Connection, ServerFlags,
    bytes_bar::bytes_bar,
    connection::{next_piece, sleep, unexpected},
    job::{self, ArtifactView},
};
use crate::cli::{CliError, Report, files};

/// Breaks in a row without a byte after which the download fails.
const MAX_BREAKS: u32 = 5;
const PAUSE: Duration = Duration::from_millis(500);

/// Arguments of `tcgs fetch`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The job: its id, or an address that ends with it
    #[arg(value_parser = job::parse)]
    job: JobId,

    /// The file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,

    #[command(flatten)]
    server: ServerFlags,

    /// Which file of a job with --rd-curve; its first if absent
    #[arg(long, value_name = "X")]
    lambda: Option<f64>,

    /// Print what was fetched as one JSON document
    #[arg(long)]
    pub(crate) json: bool,
}

/// Downloads the file, or the rest of it.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    files::check_writable(&args.output)?;
    let connection = args.server.connect()?;
    super::run(async {
        let (_, job) = job::get(&connection, args.job).await?;
        let state = job.state.name();
        let found =
            job.artifacts.into_iter().find(|file| args.lambda.is_none() || file.lambda == args.lambda);
        let Some(artifact) = found else { return Err(no_file(args, state)) };
        let resumed = download(&connection, &artifact, &args.output).await?;
        let ArtifactView { kind, bytes, sha256, .. } = artifact;
        let path = &args.output;
        let value =
            json!({ "path": path, "kind": kind, "bytes": bytes, "sha256": sha256, "resumed_at": resumed });
        Ok(Report::new(format!("wrote {} ({bytes} bytes, SHA-256 {sha256})", path.display()), &value))
    })
}

fn no_file(args: &Args, state: &str) -> CliError {
    let detail = match args.lambda {
        Some(lambda) => format!("job {} is {state} and has no file of lambda {lambda}", args.job),
        None => format!("job {} is {state}; only a succeeded job has a file", args.job),
    };
    Problem::new(ProblemType::NoArtifact, detail).into()
}

/// Downloads the file to `output`; returns the byte at which an earlier download was resumed.
async fn download(connection: &Connection, artifact: &ArtifactView, output: &Path) -> Result<u64, CliError> {
    let part = part_of(output, artifact.sha256);
    let unwritable = |error: io::Error| CliError::unwritable(&part, &error);
    let open = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&part);
    let mut file = open.map_err(unwritable)?;
    let mut hash = Sha256::new();
    let mut have = hash_start(&mut file, &mut hash, artifact.bytes).map_err(unwritable)?;
    let resumed = have;
    let bar = bytes_bar("download", artifact.bytes);
    let mut breaks = 0;
    while have < artifact.bytes {
        bar.set_position(have);
        let before = have;
        let response = request_from(connection, artifact, have).await?;
        if response.status() != StatusCode::PARTIAL_CONTENT && have > 0 {
            // The service sends the whole file, so start again.
            (have, hash) = (0, Sha256::new());
            file.set_len(0).and_then(|()| file.rewind()).map_err(unwritable)?;
        }
        let end = receive(response, &mut file, &mut hash, &mut have, &bar).await;
        end.map_err(unwritable)?;
        if have > artifact.bytes {
            return Err(unexpected(format!(
                "it sent more than the {} bytes that the file has",
                artifact.bytes
            )));
        }
        breaks = if have > before { 0 } else { breaks + 1 };
        if breaks == MAX_BREAKS {
            let detail = format!(
                "the download stopped at byte {have} of {}; run the command again to resume",
                artifact.bytes
            );
            return Err(Problem::new(ProblemType::Unreachable, detail).into());
        }
        if have < artifact.bytes {
            sleep(PAUSE).await;
        }
    }
    bar.finish_and_clear();
    let found = Digest::from_bytes(hash.finalize().into());
    if found != artifact.sha256 {
        // More bytes cannot repair it.
        let _ = std::fs::remove_file(&part);
        return Err(unexpected(format!("the file came as {found}, not as {}", artifact.sha256)));
    }
    file.sync_all().map_err(unwritable)?;
    std::fs::rename(&part, output).map_err(|error| CliError::unwritable(output, &error))?;
    Ok(resumed)
}

fn part_of(output: &Path, digest: Digest) -> PathBuf {
    let name = output.file_name().unwrap_or_default().to_string_lossy();
    output.with_file_name(format!("{name}.{}.part", &digest.to_string()[..16]))
}

/// Hashes the bytes that exist, at most `most`, and returns their number.
fn hash_start(file: &mut File, hash: &mut Sha256, max: u64) -> io::Result<u64> {
    if file.metadata()?.len() > max {
        file.set_len(0)?;
    }
    let (mut have, mut piece) = (0, vec![0; 1 << 16]);
    loop {
        let read = file.read(&mut piece)?;
        if read == 0 {
            break;
        }
        hash.update(&piece[..read]);
        have += read as u64;
    }
    file.seek(SeekFrom::Start(have))?;
    Ok(have)
}

/// Requests the file from byte `from` on, and checks the response's digest and range against the job's.
async fn request_from(
    connection: &Connection,
    artifact: &ArtifactView,
    from: u64,
) -> Result<Response, CliError> {
    let make = async || {
        let request = connection.request(Method::GET, &artifact.href)?;
        Ok(match from {
            0 => request,
            _ => request
                .header(RANGE, format!("bytes={from}-"))
                .header(IF_RANGE, format!("\"{}\"", artifact.sha256)),
        })
    };
    let response = connection.send_with_retry(make).await?;
    let header = |name: &str| response.headers().get(name).and_then(|value| value.to_str().ok());
    let stated = format!("sha-256=:{}:", STANDARD.encode(artifact.sha256.as_bytes()));
    if let Some(digest) = header("repr-digest").filter(|digest| *digest != stated) {
        return Err(unexpected(format!("it states {digest} for the file, where the job states {stated}")));
    }
    if response.status() == StatusCode::PARTIAL_CONTENT {
        let range = format!("bytes {from}-{}/{}", artifact.bytes - 1, artifact.bytes);
        if header(CONTENT_RANGE.as_str()) != Some(&*range) {
            return Err(unexpected(format!("it sent another part than {range}")));
        }
    }
    Ok(response)
}

/// Writes the response's body until it ends or breaks.
async fn receive(
    mut response: Response,
    file: &mut File,
    hash: &mut Sha256,
    have: &mut u64,
    bar: &ProgressBar,
) -> io::Result<()> {
    while let Ok(Some(piece)) = next_piece(&mut response).await {
        file.write_all(&piece)?;
        hash.update(&piece);
        *have += piece.len() as u64;
        bar.set_position(*have);
    }
    Ok(())
}
