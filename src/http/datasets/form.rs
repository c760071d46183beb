//! Receives a dataset from a form (`multipart/form-data`, RFC 7578), as browsers and `curl -F` send it: the archive in the field `file`, and
//! the parameters of the query in other fields.
//!
//! Invariants: the file streams into the same place as a body, within the same limits; everything else of a form is at most
//! [`MAX_EXTRA`] bytes, however it is divided.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering::Relaxed},
};

use axum::{
    body::BodyDataStream,
    http::{HeaderMap, header},
};
use futures_util::stream;
use multer::{Field, Multipart};
use thiserror::Error;
use tokio::task::yield_now;

use super::received::{ReceivedDataset, Sink};
use crate::{
    domain::{Digest, ProblemType, ProjectId},
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::{Pieces, announced_length},
        state::AppState,
    },
};

/// The media type.
pub(crate) const FORM: &str = "multipart/form-data";

/// The field of the archive.
const FILE: &str = "file";

/// Most bytes of a form besides its file: boundaries, heads of parts, other fields.
const MAX_EXTRA: usize = 1 << 20;
const MAX_FIELDS: usize = 100;

/// A completely received form.
#[derive(Debug)]
pub(crate) struct ReceivedForm {
    pub(crate) dataset: ReceivedDataset,
    /// The other fields. An empty one is left out: browsers send what a user did not fill in.
    pub(crate) fields: Vec<(String, String)>,
}

impl ReceivedForm {
    /// A digest of the file and the other fields.
    pub(crate) fn digest(&self) -> ApiResult<Digest> {
        let fields =
            serde_urlencoded::to_string(&self.fields).map_err(|error| ProblemResponse::internal(&error))?;
        Ok(Digest::of(format!("{}\n{fields}", self.dataset.blob().digest).as_bytes()))
    }
}

/// Why a form cannot be read further; multer passes it on.
#[derive(Debug, Error)]
#[error("the body cannot be read")]
struct BodyError(ProblemResponse);

/// Receives a form.
///
/// # Errors
/// 400 if the body is no form, 422 if it has no file or two; as for [`super::received::receive`].
pub(crate) async fn receive_form(
    state: &AppState,
    project: ProjectId,
    headers: &HeaderMap,
    body: &mut BodyDataStream,
) -> ApiResult<ReceivedForm> {
    let content_type = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let boundary = multer::parse_boundary(content_type.unwrap_or_default()).map_err(malformed)?;
    let extra = MAX_EXTRA as u64;
    let announced = announced_length(headers, state.limits.upload_bytes.saturating_add(extra))?;
    // The file is at least as long.
    let least = announced.unwrap_or(0).saturating_sub(extra);
    let extra = Extra::default();
    let mut form = Multipart::new(extra.limit(Pieces::new(body, &state.limits)), boundary);
    let (mut fields, mut dataset) = (Vec::<(String, String)>::new(), None);
    while let Some(mut part) = form.next_field().await.map_err(malformed)? {
        let Some(name) = part.name().map(str::to_owned) else {
            return Err(ProblemType::MalformedForm.because("a part of the form has no name"));
        };
        if name == FILE {
            if dataset.is_some() {
                return Err(ProblemResponse::parameter(FILE, "is given twice"));
            }
            let mut sink = Sink::open(state, project, least).await?;
            while let Some(piece) = part.chunk().await.map_err(malformed)? {
                extra.is_file(piece.len());
                sink = sink.write(state, project, &piece).await?;
            }
            dataset = Some(sink.finish(state, project).await?);
            continue;
        }
        if fields.len() == MAX_FIELDS {
            return Err(ProblemResponse::parameter("body", format!("has more than {MAX_FIELDS} fields")));
        }
        let text = text(&name, part).await?;
        if !text.is_empty() {
            fields.push((name, text));
        }
    }
    let missing = || {
        let error = format!("is missing; send the archive in this field, with curl as -F {FILE}=@scene.zip");
        ProblemResponse::parameter(FILE, error)
    };
    Ok(ReceivedForm { dataset: dataset.ok_or_else(missing)?, fields })
}

/// The text of a field; the bytes of all are bounded.
async fn text(name: &str, mut part: Field<'_>) -> ApiResult<String> {
    let mut content = Vec::new();
    while let Some(piece) = part.chunk().await.map_err(malformed)? {
        content.extend_from_slice(&piece);
    }
    String::from_utf8(content).map_err(|_| ProblemResponse::parameter(name, "is not UTF-8"))
}

/// Counts the bytes that are not the file's.
#[derive(Debug, Default)]
struct Extra(Arc<AtomicUsize>);

impl Extra {
    fn is_file(&self, length: usize) {
        self.0.fetch_sub(length, Relaxed);
    }

    /// The pieces of a body, while there are not too many of these bytes. A piece counts until the file has it.
    fn limit(
        &self,
        pieces: Pieces<'_>,
    ) -> impl futures_util::Stream<Item = Result<bytes::Bytes, BodyError>> + Send {
        let extra = Arc::clone(&self.0);
        stream::try_unfold((pieces, extra), |(mut pieces, extra)| async move {
            // multer reads until nothing is ready, however much that is; so nothing is, after each piece.
            yield_now().await;
            let Some(piece) = pieces.next().await.map_err(BodyError)? else { return Ok(None) };
            let unread = extra.fetch_add(piece.len(), Relaxed) + piece.len();
            // Two pieces may be on their way to the file.
            if unread > MAX_EXTRA + 2 * piece.len() {
                return Err(BodyError(
                    ProblemType::BodyTooLarge
                        .because(format!("the form has more than {MAX_EXTRA} bytes besides its file")),
                ));
            }
            Ok(Some((piece, (pieces, extra))))
        })
    }
}

fn malformed(error: multer::Error) -> ProblemResponse {
    match error {
        multer::Error::StreamReadFailed(cause) => match cause.downcast::<BodyError>() {
            Ok(error) => error.0,
            Err(cause) => ProblemType::BodyIncomplete.because(format!("the body could not be read: {cause}")),
        },
        error => ProblemType::MalformedForm.because(format!("the body is no form: {error}")),
    }
}
