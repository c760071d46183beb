//! Uploads a large archive in parts by the tus protocol 1.0.0 and creates a dataset from it. After a failed part, the upload resumes at the
//! offset that the service states.

use std::time::Duration;

use base64::{Engine as _, engine::general_purpose::STANDARD};
use reqwest::{
    Method, Response, StatusCode,
    header::{CONTENT_TYPE, LOCATION},
};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use tcgs::domain::{MaskMode, MaskSource, ReadOptions};

use super::{
    Connection,
    archive::Archive,
    bytes_bar::bytes_bar,
    connection::{document, sleep, unexpected},
};
use crate::cli::CliError;

const VERSION: (&str, &str) = ("tus-resumable", "1.0.0");
/// Failures in a row after which the upload fails.
const MAX_BREAKS: u32 = 8;
const PAUSE: Duration = Duration::from_millis(500);

/// The id of a dataset created from the archive, or `None` if it fits into one part or the service takes no parts.
pub(super) async fn scene_of(
    connection: &Connection,
    archive: &Archive,
    part_bytes: u64,
    read: &ReadOptions,
) -> Result<Option<String>, CliError> {
    if archive.bytes <= part_bytes || !takes_parts(connection).await? {
        return Ok(None);
    }
    let begin = async || {
        let request = connection.request(Method::POST, "/v1/uploads")?.header(VERSION.0, VERSION.1);
        Ok(request.header("upload-length", archive.bytes))
    };
    // If an answer is lost, the repetition begins another upload; the service ends the first one when nothing is sent to it.
    let created = connection.send_with_retry(begin).await?;
    let upload =
        text(&created, LOCATION.as_str()).ok_or_else(|| unexpected("it names no place for the upload"))?;
    send_parts(connection, archive, part_bytes, &upload).await?;
    let id = upload.rsplit('/').next().unwrap_or_default();
    let scene: Value = document(connection.post("/v1/scenes", &request(id, read)).await?).await?;
    let id = scene["id"].as_str().ok_or_else(|| unexpected("its scene has no id"))?;
    Ok(Some(id.to_owned()))
}

/// The request for a dataset of an upload, without fields that have their defaults: earlier services do not know all of them.
fn request(upload: &str, read: &ReadOptions) -> Value {
    let ReadOptions { masks, mask_mode, skip_missing, .. } = read;
    let mut wanted = json!({ "upload_id": upload });
    if *skip_missing {
        wanted["skip_missing"] = true.into();
    }
    if *masks != MaskSource::default() {
        wanted["masks"] = json!(masks);
    }
    if *mask_mode != MaskMode::default() {
        wanted["mask_mode"] = json!(mask_mode);
    }
    wanted
}

async fn takes_parts(connection: &Connection) -> Result<bool, CliError> {
    let make = async || connection.request(Method::OPTIONS, "/v1/uploads");
    match connection.send_with_retry(make).await {
        Ok(answer) => Ok(text(&answer, "tus-version").is_some_and(|versions| versions.contains(VERSION.1))),
        Err(CliError::Problem(problem)) if matches!(problem.status, 404 | 405) => Ok(false),
        Err(error) => Err(error),
    }
}

async fn send_parts(
    connection: &Connection,
    archive: &Archive,
    part_bytes: u64,
    upload: &str,
) -> Result<(), CliError> {
    let bar = bytes_bar("upload", archive.bytes);
    let (mut offset, mut breaks) = (0, 0);
    while offset < archive.bytes {
        bar.set_position(offset);
        let part = archive.part(offset, part_bytes)?;
        let request = connection
            .request(Method::PATCH, upload)?
            .header(VERSION.0, VERSION.1)
            .header("upload-offset", offset)
            .header("upload-checksum", format!("sha256 {}", STANDARD.encode(Sha256::digest(&part))))
            .header(CONTENT_TYPE, "application/offset+octet-stream")
            .body(part);
        match connection.send(request).await {
            Ok(answer) => (offset, breaks) = (offset_of(&answer)?, 0),
            Err(error) if breaks < MAX_BREAKS && is_retryable(&error) => {
                breaks += 1;
                sleep(PAUSE * breaks).await;
                let make =
                    async || Ok(connection.request(Method::HEAD, upload)?.header(VERSION.0, VERSION.1));
                offset = offset_of(&connection.send_with_retry(make).await?)?;
            }
            Err(error) => return Err(error),
        }
    }
    bar.finish_and_clear();
    Ok(())
}

/// Whether to retry a part: the connection broke, the service was busy or is still writing the part before, or it has another offset or
/// checksum than the part stated.
fn is_retryable(error: &CliError) -> bool {
    match error {
        CliError::Problem(problem) => matches!(problem.status, 408 | 409 | 423 | 429 | 460 | 502..=504),
        CliError::Usage(_) | CliError::Reported { .. } | CliError::Stopped { .. } => false,
    }
}

fn offset_of(answer: &Response) -> Result<u64, CliError> {
    let offset = text(answer, "upload-offset").and_then(|offset| offset.parse().ok());
    offset.ok_or_else(|| {
        unexpected(format!("its answer ({}) tells no offset", StatusCode::as_u16(&answer.status())))
    })
}

fn text(answer: &Response, header: &str) -> Option<String> {
    answer.headers().get(header)?.to_str().ok().map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dataset_is_checked_as_its_job_will_read_it() {
        assert_eq!(request("u", &ReadOptions::default()), json!({ "upload_id": "u" }));
        let read = ReadOptions {
            masks: MaskSource::None,
            mask_mode: MaskMode::CutOut,
            skip_missing: true,
            ..ReadOptions::default()
        };
        let wanted =
            json!({ "upload_id": "u", "masks": "none", "mask_mode": "cut_out", "skip_missing": true });
        assert_eq!(request("u", &read), wanted);
    }
}
