//! The hook through which tests let calls of the store fail.
//!
//! Invariant: every method of [`Store`] that returns a [`StoreFuture`] begins with [`Store::call`] or [`Store::create`], and calls no
//! other such method. So the hook decides about each call once.

use std::{
    future::{Future, ready},
    sync::Arc,
};

use super::Store;
use crate::store::{StoreError, StoreFuture};

/// Decides which calls of a [`Store`] fail, for tests.
pub trait StoreFaults: Send + Sync + 'static {
    /// The error with which this call of `method` fails before it does anything; `None` lets it run.
    fn fault(&self, method: &'static str) -> Option<StoreError>;

    /// Receives the work of a failed call that creates a job, a dataset or an export. Awaiting it later imitates a database that commits
    /// after its client has given up; by default it is dropped.
    fn failed_creation(&self, work: StoreFuture<'static, ()>) {
        drop(work);
    }
}

/// A call of a method, with the error that it fails with.
pub(super) struct Call(Option<StoreError>);

impl Call {
    /// Does the work of the call, unless it fails.
    pub(super) fn run<'a, T: Send + 'a>(
        self,
        work: impl Future<Output = Result<T, StoreError>> + Send + 'a,
    ) -> StoreFuture<'a, T> {
        match self.0 {
            None => Box::pin(work),
            Some(error) => Box::pin(ready(Err(error))),
        }
    }
}

impl Store {
    /// This store, with calls that fail as `faults` decides.
    #[doc(hidden)]
    #[must_use]
    pub fn with_faults(self, faults: Arc<dyn StoreFaults>) -> Self {
        Self { faults: Some(faults), ..self }
    }

    /// Begins a call of `method`.
    pub(super) fn call(&self, method: &'static str) -> Call {
        Call(self.faults.as_ref().and_then(|faults| faults.fault(method)))
    }

    /// Calls a method that creates something. `work` borrows nothing from the caller, so that it can be done after the call has failed.
    pub(super) fn create<T: Send + 'static>(
        &self,
        method: &'static str,
        work: impl for<'s> FnOnce(&'s Self) -> StoreFuture<'s, T> + Send + 'static,
    ) -> StoreFuture<'_, T> {
        match (self.call(method), &self.faults) {
            (Call(Some(error)), Some(faults)) => {
                let store = self.clone();
                faults.failed_creation(Box::pin(async move { work(&store).await.map(drop) }));
                Box::pin(ready(Err(error)))
            }
            _ => work(self),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{fs, path::Path, sync::Mutex};

    use uuid::Uuid;

    use super::*;
    use crate::{
        domain::{Digest, JobId, TrainOptions},
        store::{BlobRef, NewJob, sql::open::temporary_store},
    };

    /// Fails every call, and keeps the work of creations.
    #[derive(Default)]
    struct Failing(Mutex<Vec<StoreFuture<'static, ()>>>);

    impl StoreFaults for Failing {
        fn fault(&self, _: &'static str) -> Option<StoreError> {
            Some(StoreError::Database(sqlx::Error::PoolTimedOut))
        }

        fn failed_creation(&self, work: StoreFuture<'static, ()>) {
            self.0.lock().expect("not poisoned").push(work);
        }
    }

    #[tokio::test]
    async fn a_failed_creation_does_nothing_until_its_work_is_awaited() {
        let (_folder, store) = temporary_store().await;
        let faults = Arc::new(Failing::default());
        let failing = store.clone().with_faults(faults.clone());
        let id = JobId(Uuid::from_u128(1));
        let dataset = BlobRef { digest: Digest::from_bytes([1; 32]), bytes: 1 };
        failing.create_job(NewJob::new(id, TrainOptions::default(), dataset)).await.expect_err("it fails");
        failing.job(id).await.expect_err("it fails");
        assert_eq!(store.job(id).await.expect("read"), None);
        let work = std::mem::take(&mut *faults.0.lock().expect("not poisoned"));
        assert_eq!(work.len(), 1, "reading creates nothing");
        for work in work {
            work.await.expect("created");
        }
        assert!(store.job(id).await.expect("read").is_some());
    }

    #[test]
    fn every_method_begins_with_a_call_of_its_name() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/store/sql");
        let mut methods = 0;
        for file in fs::read_dir(folder).expect("the sources") {
            let path = file.expect("a file").path();
            if path.is_dir() {
                continue;
            }
            let text = fs::read_to_string(&path).expect("a source");
            for method in text.split("\n    pub fn ").skip(1) {
                let (signature, body) = method.split_once('{').expect("a body");
                if !signature.contains("-> StoreFuture<") {
                    continue;
                }
                let name = signature.split(['(', '<']).next().expect("a name");
                let body = body.split("\n    }\n").next().expect("a body");
                let calls = [format!(".call(\"{name}\")"), format!(".create(\"{name}\"")];
                assert!(calls.iter().any(|call| body.contains(call)), "{}: {name}", path.display());
                methods += 1;
            }
        }
        assert!(methods > 70, "{methods}");
    }
}
