//! Bounds the memory of answers that are whole before they are sent: a client that reads slowly may take hours for one.

use std::sync::Arc;

use axum::http::{HeaderValue, header};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::{
    domain::ProblemType,
    http::problem::{Answer as _, ApiResult},
};

/// Longest answer, in bytes, that is not counted.
const SMALL: usize = 1 << 20;

/// Seconds after which to try again.
const RETRY_AFTER: HeaderValue = HeaderValue::from_static("5");

/// Room for whole answers.
#[derive(Debug)]
pub(crate) struct HeldBytes(Arc<Semaphore>);

/// The room of one answer, until this is dropped; none is taken for a small one.
#[derive(Debug)]
pub(crate) struct Held(Option<OwnedSemaphorePermit>);

impl Held {
    /// Whether the answer is counted.
    pub(crate) fn is_counted(&self) -> bool {
        self.0.is_some()
    }
}

impl HeldBytes {
    /// Room for this many bytes.
    pub(crate) fn new(bytes: u64) -> Self {
        let permits = usize::try_from(bytes).unwrap_or(usize::MAX).min(Semaphore::MAX_PERMITS);
        Self(Arc::new(Semaphore::new(permits)))
    }

    /// Takes the room for an answer of this length.
    ///
    /// # Errors
    /// 503 while other answers have it.
    pub(crate) fn hold(&self, bytes: usize) -> ApiResult<Held> {
        let mut held = Held(None);
        self.grow(&mut held, bytes)?;
        Ok(held)
    }

    /// Takes the room for more of an answer, which has this length by now.
    ///
    /// # Errors
    /// 503 while other answers have it.
    pub(crate) fn grow(&self, held: &mut Held, bytes: usize) -> ApiResult<()> {
        if bytes <= SMALL {
            return Ok(());
        }
        let has = held.0.as_ref().map_or(0, OwnedSemaphorePermit::num_permits);
        let permit = u32::try_from(bytes.saturating_sub(has)).ok().and_then(|bytes| {
            let room = Arc::clone(&self.0);
            room.try_acquire_many_owned(bytes).ok()
        });
        let full = || {
            let detail = "too many large pictures are being sent to clients that read slowly";
            ProblemType::Busy.because(detail).with_header(header::RETRY_AFTER, RETRY_AFTER)
        };
        let more = permit.ok_or_else(full)?;
        match &mut held.0 {
            Some(permit) => permit.merge(more),
            none => *none = Some(more),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_answers_share_the_room_and_give_it_back() {
        let room = HeldBytes::new(5 << 20);
        let first = room.hold(3 << 20).expect("there is room");
        assert!(room.hold(3 << 20).is_err());
        assert!(!room.hold(SMALL).expect("needs none").is_counted());
        drop(first);
        assert!(room.hold(3 << 20).expect("there is room again").is_counted());
    }

    #[test]
    fn an_answer_that_grows_takes_the_room_of_its_length() {
        let room = HeldBytes::new(5 << 20);
        let mut growing = room.hold(0).expect("needs none");
        for length in [SMALL, SMALL + 1, 2 << 20, 2 << 20, 4 << 20] {
            room.grow(&mut growing, length).expect("there is room");
        }
        assert_eq!(room.0.available_permits(), 1 << 20);
        assert!(room.grow(&mut growing, 6 << 20).is_err());
        drop(growing);
        assert_eq!(room.0.available_permits(), 5 << 20);
    }
}
