//! Publishes the result of an attempt, and again while its job cannot refer to it.
//!
//! Until the end of the attempt is recorded nothing refers to the result, so it is garbage once the grace time of its publication is over.
//! A database whose disk is full may take longer than that. The contents therefore stay in memory until the end.

use std::time::Duration;

use bytes::Bytes;
use tokio::time::Instant;

use super::storage;
use crate::{
    domain::{FailurePoint, Problem, ProblemType, failure_point::reach},
    pipeline::JobOutput,
    store::{Artifact, ArtifactKind, BlobError, Blobs, Outcome},
};

/// What a job is finished with.
pub(super) struct Finished {
    pub(super) output: JobOutput,
    /// COLMAP's model as a zip archive, if its cameras were found here.
    pub(super) sparse_model: Option<Vec<u8>>,
}

/// The end of an attempt that is to be recorded.
pub(super) struct Ending {
    pub(super) outcome: Outcome,
    /// The result, if it has one.
    publication: Option<Publication>,
}

struct Publication {
    contents: Vec<Bytes>,
    /// When the latest publication began.
    started: Instant,
}

impl From<Outcome> for Ending {
    fn from(outcome: Outcome) -> Self {
        Self { outcome, publication: None }
    }
}

impl Ending {
    /// Publishes the result again if that was last done longer than `age` ago. What was removed meanwhile is written anew.
    ///
    /// # Errors
    /// As [`Blobs::put`]; the result must not be referred to.
    pub(super) async fn renew(&mut self, blobs: &Blobs, age: Duration) -> Result<(), BlobError> {
        let Some(Publication { contents, started }) = &mut self.publication else { return Ok(()) };
        if started.elapsed() < age {
            return Ok(());
        }
        let now = Instant::now();
        for content in contents {
            blobs.put(content.clone()).await?;
        }
        *started = now;
        Ok(())
    }
}

/// Makes the output's blobs durable; only then may the job refer to them.
pub(super) async fn publish(blobs: &Blobs, finished: Finished) -> Ending {
    let contents = match contents(&finished) {
        Ok(contents) => contents,
        Err(error) => {
            tracing::error!("JSON cannot be written: {error}");
            let detail = "the dataset's cameras or held-out views cannot be written as JSON";
            return Outcome::Failed(Problem::new(ProblemType::Internal, detail)).into();
        }
    };
    let started = Instant::now();
    let (mut artifacts, mut published) = (Vec::new(), Vec::new());
    for (kind, lambda, content) in contents {
        reach(FailurePoint::BeforePublish);
        match blobs.put(content.clone()).await {
            Ok(blob) => artifacts.push(Artifact { kind, lambda, blob }),
            Err(error) => return storage::outcome(&error).into(),
        }
        published.push(content);
        reach(FailurePoint::AfterPublish);
    }
    Ending {
        outcome: Outcome::Succeeded { metrics: Box::new(finished.output.metrics), artifacts },
        publication: Some(Publication { contents: published, started }),
    }
}

/// Kind, weight of the rate term and content of every artifact: the files, the cameras and held-out views as JSON, and pictures.
fn contents(finished: &Finished) -> serde_json::Result<Vec<(ArtifactKind, Option<f64>, Bytes)>> {
    let Finished { output, sparse_model } = finished;
    let file = |(lambda, file)| (ArtifactKind::Scene(output.format), lambda, Bytes::copy_from_slice(file));
    let mut contents: Vec<_> = output.files().map(file).collect();
    contents.push((ArtifactKind::Cameras, None, serde_json::to_vec(&output.cameras)?.into()));
    if let Some(held_out) = &output.held_out {
        contents.push((ArtifactKind::HeldOut, None, serde_json::to_vec(held_out)?.into()));
    }
    if let Some(thumbnail) = &output.thumbnail {
        contents.push((ArtifactKind::Thumbnail, None, Bytes::copy_from_slice(thumbnail)));
    }
    if let Some(model) = sparse_model {
        contents.push((ArtifactKind::SparseModel, None, Bytes::copy_from_slice(model)));
    }
    Ok(contents)
}
