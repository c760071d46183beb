//! Conversions between rows and values. Values read back are checked: an invalid row is an error, not a panic.

use std::{io, str::FromStr, time::Duration};

use super::db::Row;
use crate::{
    domain::{
        DatasetId, Digest, EndpointId, Event, EventKind, ExportFidelity, Job, JobId, JobState, Preparation,
        ProjectId, SeriesPoint, WebhookEvent, WebhookSecret,
    },
    store::{
        Artifact, ArtifactKind, AttemptRecord, BlobRef, DeliveryRecord, DueDelivery, EndpointRecord,
        ExportRecord, FileRecord, JobRecord, JobVersion, PriorRequest, StoreError,
        leases::LeaseRow,
        retry::{AttemptState, LossStreak},
    },
};
use jiff::{SignedDuration, Timestamp};
use serde::{Serialize, de::DeserializeOwned};
use serde_json::ser::{CharEscape, CompactFormatter, Formatter};

pub(super) fn micros(at: Timestamp) -> i64 {
    at.as_microsecond()
}

/// A count as columns hold it, clamped.
pub(super) fn signed(count: u64) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

/// The instant `delay` after `now`.
pub(super) fn after(now: Timestamp, delay: Duration) -> Timestamp {
    SignedDuration::try_from(delay)
        .ok()
        .and_then(|delay| now.checked_add(delay).ok())
        .unwrap_or(Timestamp::MAX)
}

/// The instant `delay` before `now`.
pub(super) fn before(now: Timestamp, delay: Duration) -> Timestamp {
    SignedDuration::try_from(delay)
        .ok()
        .and_then(|delay| now.checked_sub(delay).ok())
        .unwrap_or(Timestamp::MIN)
}

/// The value as JSON. U+FFFD stands for U+0000, which PostgreSQL's JSON functions refuse.
pub(super) fn json<T: Serialize>(value: &T) -> Result<String, StoreError> {
    let corrupt = |error: String| StoreError::Corrupt { what: "value to store", error };
    let mut written = Vec::new();
    let mut writer = serde_json::Serializer::with_formatter(&mut written, WithoutNul);
    value.serialize(&mut writer).map_err(|error| corrupt(error.to_string()))?;
    String::from_utf8(written).map_err(|error| corrupt(error.to_string()))
}

/// Compact JSON with U+FFFD for U+0000.
struct WithoutNul;

impl Formatter for WithoutNul {
    fn write_char_escape<W: io::Write + ?Sized>(
        &mut self,
        writer: &mut W,
        escape: CharEscape,
    ) -> io::Result<()> {
        match escape {
            CharEscape::AsciiControl(0) => write!(writer, "{}", char::REPLACEMENT_CHARACTER),
            escape => CompactFormatter.write_char_escape(writer, escape),
        }
    }
}

/// A `serde` enum's bare name, as columns hold it.
pub(super) fn name<T: Serialize>(value: &T) -> Result<String, StoreError> {
    Ok(json(value)?.trim_matches('"').to_owned())
}

fn corrupt(what: &'static str) -> impl Fn(String) -> StoreError {
    move |error| StoreError::Corrupt { what, error }
}

pub(super) fn instant(what: &'static str, value: i64) -> Result<Timestamp, StoreError> {
    Timestamp::from_microsecond(value).map_err(|error| corrupt(what)(error.to_string()))
}

pub(super) fn from_json<T: DeserializeOwned>(what: &'static str, text: &str) -> Result<T, StoreError> {
    serde_json::from_str(text).map_err(|error| corrupt(what)(error.to_string()))
}

fn from_name<T: DeserializeOwned>(what: &'static str, text: String) -> Result<T, StoreError> {
    serde_json::from_value(serde_json::Value::String(text)).map_err(|error| corrupt(what)(error.to_string()))
}

pub(super) fn parsed<T: FromStr>(what: &'static str, text: &str) -> Result<T, StoreError> {
    text.parse().map_err(|_| corrupt(what)(format!("'{text}'")))
}

/// An integer of any kind.
pub(super) fn integer<T: TryFrom<i64>>(row: &Row, column: &'static str) -> Result<T, StoreError> {
    let value: i64 = row.try_get(column)?;
    T::try_from(value).map_err(|_| corrupt(column)(format!("{value} is out of range")))
}

pub(super) fn optional_integer<T: TryFrom<i64>>(
    row: &Row,
    column: &'static str,
) -> Result<Option<T>, StoreError> {
    let Some(value) = row.try_get::<Option<i64>>(column)? else { return Ok(None) };
    T::try_from(value).map(Some).map_err(|_| corrupt(column)(format!("{value} is out of range")))
}

pub(super) fn optional_instant(row: &Row, column: &'static str) -> Result<Option<Timestamp>, StoreError> {
    row.try_get::<Option<i64>>(column)?.map(|value| instant(column, value)).transpose()
}

pub(super) fn optional_parsed<T: FromStr>(row: &Row, column: &'static str) -> Result<Option<T>, StoreError> {
    row.try_get::<Option<String>>(column)?.map(|text| parsed(column, &text)).transpose()
}

fn optional_document<T: DeserializeOwned>(row: &Row, column: &'static str) -> Result<Option<T>, StoreError> {
    row.try_get::<Option<String>>(column)?.map(|text| from_json(column, &text)).transpose()
}

pub(super) fn blob(row: &Row, digest: &'static str) -> Result<BlobRef, StoreError> {
    Ok(BlobRef { digest: parsed(digest, row.try_get(digest)?)?, bytes: integer(row, "bytes")? })
}

/// The dataset of a row of `jobs`.
pub(super) fn dataset_id(row: &Row) -> Result<Option<DatasetId>, StoreError> {
    optional_parsed(row, "scene")
}

pub(super) fn job_id(row: &Row) -> Result<JobId, StoreError> {
    parsed("id", row.try_get("id")?)
}

pub(super) fn job_and_project(row: &Row) -> Result<(JobId, ProjectId), StoreError> {
    Ok((job_id(row)?, parsed("project", row.try_get("project")?)?))
}

pub(super) fn newest_event(row: &Row) -> Result<(JobId, u64), StoreError> {
    Ok((job_id(row)?, integer(row, "last_seq")?))
}

pub(super) fn job_version(row: &Row) -> Result<(JobId, JobVersion), StoreError> {
    let state = parsed("state", row.try_get("state")?)?;
    Ok((job_id(row)?, JobVersion { version: integer(row, "version")?, state }))
}

/// The job whose checkpoint another may resume from.
pub(super) fn resume_from(row: &Row) -> Result<Option<JobId>, StoreError> {
    optional_parsed(row, "resume_from")
}

/// What a dataset needs, or a worker can do.
pub(super) fn preparation(row: &Row, column: &'static str) -> Result<Preparation, StoreError> {
    let place: usize = integer(row, column)?;
    let found = Preparation::ALL.get(place).copied();
    found.ok_or_else(|| corrupt(column)(format!("{place} is out of range")))
}

/// The place of [`Preparation`] in its order, as the database has it.
pub(super) fn preparation_place(preparation: Preparation) -> i64 {
    preparation as i64
}

pub(super) fn dataset(row: &Row) -> Result<Digest, StoreError> {
    parsed("dataset", row.try_get("dataset")?)
}

pub(super) fn options(row: &Row) -> Result<crate::domain::TrainOptions, StoreError> {
    from_json("options", row.try_get("options")?)
}

/// What a job has in other rows than its own.
pub(super) struct JobParts {
    pub(super) artifacts: Vec<Artifact>,
    pub(super) attempts: Vec<AttemptRecord>,
    pub(super) queue_position: Option<u32>,
}

/// A row of `jobs` joined with its dataset's `bytes`.
pub(super) fn job(row: &Row, parts: JobParts) -> Result<JobRecord, StoreError> {
    let state: JobState = parsed("state", row.try_get("state")?)?;
    let job = Job {
        id: job_id(row)?,
        state,
        phase: from_name("phase", row.try_get("phase")?)?,
        options: options(row)?,
        progress: from_json("progress", row.try_get("progress")?)?,
        metrics: optional_document(row, "metrics")?,
        error: optional_document(row, "error")?,
        attempt: integer(row, "attempt")?,
        cancel_requested: row.try_get::<Option<i64>>("cancel_requested_at")?.is_some(),
        version: integer(row, "version")?,
        created_at: instant("created_at", row.try_get("created_at")?)?,
        started_at: optional_instant(row, "started_at")?,
        finished_at: optional_instant(row, "finished_at")?,
    };
    Ok(JobRecord {
        job,
        project: parsed("project", row.try_get("project")?)?,
        key: optional_parsed(row, "owner")?,
        name: row.try_get("name")?,
        metadata: from_json("metadata", row.try_get("metadata")?)?,
        queue_position: parts.queue_position,
        attempts: parts.attempts,
        dataset_id: optional_parsed(row, "scene")?,
        retry_of: optional_parsed(row, "retry_of")?,
        resume_from: resume_from(row)?,
        deadline_at: optional_instant(row, "deadline_at")?,
        priority: integer(row, "priority")?,
        dataset: blob(row, "dataset")?,
        needs: preparation(row, "needs")?,
        photographs: optional_parsed(row, "photographs")?,
        artifacts: parts.artifacts,
    })
}

/// A row of `artifacts` joined with its blob's `bytes`.
pub(super) fn artifact(row: &Row) -> Result<Artifact, StoreError> {
    let kind: ArtifactKind = from_name("artifact kind", row.try_get("kind")?)?;
    Ok(Artifact { kind, lambda: row.try_get("lambda")?, blob: blob(row, "digest")? })
}

pub(super) fn event(row: &Row) -> Result<Event, StoreError> {
    let kind: EventKind = from_name("event kind", row.try_get("kind")?)?;
    Ok(Event {
        seq: integer(row, "seq")?,
        at: instant("at", row.try_get("at")?)?,
        kind,
        attempt: integer(row, "attempt")?,
        data: from_json("event data", row.try_get("data")?)?,
    })
}

pub(super) fn attempt(row: &Row) -> Result<AttemptRecord, StoreError> {
    Ok(AttemptRecord {
        number: integer(row, "number")?,
        worker: row.try_get("worker")?,
        started_at: instant("started_at", row.try_get("started_at")?)?,
        ended_at: optional_instant(row, "ended_at")?,
        outcome: optional_parsed(row, "outcome")?,
        cause: optional_document(row, "cause")?,
    })
}

/// A row of `exports` joined with its blob's `bytes`.
pub(super) fn export(row: &Row) -> Result<ExportRecord, StoreError> {
    Ok(ExportRecord {
        job: parsed("job_id", row.try_get("job_id")?)?,
        source: parsed("source", row.try_get("source")?)?,
        format: from_name("export format", row.try_get("format")?)?,
        blob: blob(row, "digest")?,
        gaussians: integer(row, "gaussians")?,
        sh_degree: integer(row, "sh_degree")?,
        fidelity: fidelity(row)?,
    })
}

fn fidelity(row: &Row) -> Result<Option<ExportFidelity>, StoreError> {
    let psnr: Option<f64> = row.try_get("likeness_psnr")?;
    psnr.map(|psnr| Ok(ExportFidelity { psnr, views: integer(row, "likeness_views")? })).transpose()
}

/// A file of a job or of its exports, joined with its blob's `bytes`.
pub(super) fn file(row: &Row) -> Result<FileRecord, StoreError> {
    Ok(FileRecord {
        job: parsed("job_id", row.try_get("job_id")?)?,
        kind: from_name("artifact kind", row.try_get("kind")?)?,
        lambda: row.try_get("lambda")?,
        blob: blob(row, "digest")?,
    })
}

pub(super) fn prior_request(row: &Row) -> Result<PriorRequest, StoreError> {
    Ok(PriorRequest {
        fingerprint: parsed("fingerprint", row.try_get("fingerprint")?)?,
        status: integer(row, "status")?,
        resource: row.try_get("resource")?,
    })
}

/// The deadline of a row that has one.
pub(super) fn deadline(row: &Row) -> Result<Timestamp, StoreError> {
    instant("deadline_at", row.try_get("deadline_at")?)
}

pub(super) fn attempt_state(row: &Row, now: Timestamp) -> Result<AttemptState, StoreError> {
    let checkpoint: u64 = integer(row, "checkpoint_step")?;
    Ok(AttemptState {
        missed_deadline: optional_instant(row, "deadline_at")?.filter(|deadline| *deadline <= now),
        job: job_id(row)?,
        attempt: integer(row, "attempt")?,
        charged: integer(row, "charged")?,
        max_attempts: integer(row, "max_attempts")?,
        holds: 0,
        losses: LossStreak { alone: integer(row, "silent_deaths")?, with_service: integer(row, "setbacks")? },
        checkpoint,
        checkpoint_advanced: checkpoint > integer::<u64>(row, "setback_step")?,
        cancel_requested: row.try_get::<Option<i64>>("cancel_requested_at")?.is_some(),
    })
}

/// The lease of a running job.
pub(super) fn lease(row: &Row) -> Result<LeaseRow, StoreError> {
    Ok(LeaseRow { job: job_id(row)?, attempt: integer(row, "attempt")?, until: row.try_get("lease_until")? })
}

/// A row of `series`.
pub(super) fn point(row: &Row) -> Result<SeriesPoint, StoreError> {
    Ok(SeriesPoint {
        attempt: integer(row, "attempt")?,
        step: integer(row, "step")?,
        seconds: row.try_get("seconds")?,
        loss: row.try_get("loss")?,
        psnr: row.try_get("psnr")?,
        ssim: row.try_get("ssim")?,
        anchors: integer(row, "anchors")?,
        gaussians: integer(row, "gaussians")?,
        bytes: optional_integer(row, "bytes")?,
    })
}

pub(super) fn endpoint_id(row: &Row) -> Result<EndpointId, StoreError> {
    parsed("id", row.try_get("id")?)
}

/// A row of `webhook_endpoints`.
pub(super) fn endpoint(row: &Row) -> Result<EndpointRecord, StoreError> {
    let names: Vec<String> = from_json("events", row.try_get("events")?)?;
    let events: Result<Vec<WebhookEvent>, StoreError> =
        names.iter().map(|name| parsed("events", name)).collect();
    Ok(EndpointRecord {
        id: endpoint_id(row)?,
        project: parsed("project", row.try_get("project")?)?,
        url: row.try_get("url")?,
        events: events?,
        description: row.try_get("description")?,
        created_at: instant("created_at", row.try_get("created_at")?)?,
        disabled_at: optional_instant(row, "disabled_at")?,
    })
}

/// A row of `webhook_deliveries`.
pub(super) fn delivery(row: &Row) -> Result<DeliveryRecord, StoreError> {
    Ok(DeliveryRecord {
        seq: integer(row, "seq")?,
        id: parsed("id", row.try_get("id")?)?,
        job: parsed("job", row.try_get("job")?)?,
        event: parsed("event", row.try_get("event")?)?,
        state: parsed("state", row.try_get("state")?)?,
        attempts: integer(row, "attempts")?,
        due_at: optional_instant(row, "due_at")?,
        created_at: instant("created_at", row.try_get("created_at")?)?,
        attempted_at: optional_instant(row, "attempted_at")?,
        delivered_at: optional_instant(row, "delivered_at")?,
        response_status: optional_integer(row, "answer_status")?,
        error: row.try_get("answer_fault")?,
    })
}

/// A delivery with its endpoint's address and secret.
pub(super) fn due_delivery(row: &Row, at: Timestamp) -> Result<DueDelivery, StoreError> {
    Ok(DueDelivery {
        id: parsed("id", row.try_get("id")?)?,
        attempt: integer(row, "attempts")?,
        tries: integer(row, "tries")?,
        url: row.try_get("url")?,
        secret: WebhookSecret::stored(row.try_get("secret")?),
        body: row.try_get("body")?,
        at,
    })
}
