//! A bucket whose n-th request fails: before it reaches the server, or after, when its answer is lost. It can also hold a put back.

use std::{
    fmt, io,
    ops::Range,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
};

use async_trait::async_trait;
use bytes::Bytes;
use futures_util::{
    FutureExt as _, StreamExt as _, TryStreamExt as _, future,
    stream::{self, BoxStream},
};
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    PutMultipartOptions, PutOptions, PutPayload, PutResult, Result, UploadPart, path::Path,
};
use tokio::sync::oneshot;

/// Where a request fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// The server never gets it.
    Request,
    /// The server has done what it asks, and the answer is lost.
    Answer,
}

#[derive(Debug, Default)]
struct Plan {
    /// Requests until the one that fails.
    left: AtomicU32,
    /// How those begin that count, as `list checkpoints/`.
    of: Mutex<String>,
    fault: Mutex<Option<(Side, io::ErrorKind)>>,
    failed: AtomicU32,
    /// Where the next put says that it was asked for, and what it waits for.
    held: Mutex<Option<(oneshot::Sender<()>, oneshot::Receiver<()>)>>,
}

/// A put that is held back.
#[derive(Debug)]
pub struct HeldPut {
    /// Ends once it is asked for.
    pub asked: oneshot::Receiver<()>,
    /// Lets it reach the server.
    pub release: oneshot::Sender<()>,
}

impl Plan {
    /// How the next request fails, if it does.
    fn next(&self, request: &str) -> Option<(Side, Error)> {
        let fault = *self.fault.lock().expect("not poisoned");
        let (side, kind) = fault?;
        if !request.starts_with(&*self.of.lock().expect("not poisoned")) {
            return None;
        }
        if self.left.fetch_sub(1, Ordering::SeqCst) != 1 {
            return None;
        }
        self.failed.fetch_add(1, Ordering::SeqCst);
        Some((side, Error::Generic { store: "S3", source: Box::new(io::Error::from(kind)) }))
    }

    async fn apply<T>(&self, what: &str, request: impl Future<Output = Result<T>>) -> Result<T> {
        match self.next(what) {
            None => request.await,
            Some((Side::Request, error)) => Err(error),
            Some((Side::Answer, error)) => request.await.and(Err(error)),
        }
    }
}

/// The bucket.
#[derive(Debug, Clone)]
pub struct FaultyBucket {
    inner: Arc<dyn ObjectStore>,
    plan: Arc<Plan>,
}

impl FaultyBucket {
    pub fn new(inner: Arc<dyn ObjectStore>) -> Self {
        Self { inner, plan: Arc::default() }
    }

    /// Lets the `request`-th request from now on fail.
    pub fn plan(&self, side: Side, kind: io::ErrorKind, request: u32) {
        self.plan_of("", side, kind, request);
    }

    /// Lets the `request`-th request from now on fail that begins like this: `list checkpoints/`, or `delete` without a name.
    pub fn plan_of(&self, of: &str, side: Side, kind: io::ErrorKind, request: u32) {
        of.clone_into(&mut self.plan.of.lock().expect("not poisoned"));
        self.plan.left.store(request, Ordering::SeqCst);
        self.plan.failed.store(0, Ordering::SeqCst);
        *self.plan.fault.lock().expect("not poisoned") = Some((side, kind));
    }

    /// Holds the next put back before it reaches the server.
    pub fn hold_next_put(&self) -> HeldPut {
        let ((ask, asked), (release, released)) = (oneshot::channel(), oneshot::channel());
        *self.plan.held.lock().expect("not poisoned") = Some((ask, released));
        HeldPut { asked, release }
    }

    /// Lets no request fail any more, and returns whether one has.
    pub fn relieve(&self) -> bool {
        *self.plan.fault.lock().expect("not poisoned") = None;
        self.plan.failed.load(Ordering::SeqCst) > 0
    }
}

/// What a list asks for.
fn listing(prefix: Option<&Path>) -> String {
    format!("list {}", prefix.map(Path::as_ref).unwrap_or_default())
}

impl fmt::Display for FaultyBucket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

#[async_trait]
impl ObjectStore for FaultyBucket {
    async fn put_opts(&self, location: &Path, payload: PutPayload, opts: PutOptions) -> Result<PutResult> {
        let held = self.plan.held.lock().expect("not poisoned").take();
        if let Some((ask, released)) = held {
            ask.send(()).expect("the test waits for it");
            released.await.expect("the test releases it");
        }
        self.plan.apply(&format!("put {location}"), self.inner.put_opts(location, payload, opts)).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        let upload = self
            .plan
            .apply(&format!("put {location}"), self.inner.put_multipart_opts(location, opts))
            .await?;
        Ok(Box::new(FaultUpload { inner: upload, plan: Arc::clone(&self.plan) }))
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.plan.apply(&format!("get {location}"), self.inner.get_opts(location, options)).await
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.plan.apply(&format!("get {location}"), self.inner.get_ranges(location, ranges)).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        let deleted = |inner: &Arc<dyn ObjectStore>| inner.delete_stream(locations);
        match self.plan.next("delete") {
            None => deleted(&self.inner),
            Some((Side::Request, error)) => stream::once(future::ready(Err(error))).boxed(),
            Some((Side::Answer, error)) => {
                let done = deleted(&self.inner).try_collect::<Vec<_>>();
                stream::once(async move { done.await.and(Err(error)) }).boxed()
            }
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        match self.plan.next(&listing(prefix)) {
            None => self.inner.list(prefix),
            Some((_, error)) => stream::once(future::ready(Err(error))).boxed(),
        }
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.plan.apply(&listing(prefix), self.inner.list_with_delimiter(prefix)).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.plan.apply(&format!("copy {from}"), self.inner.copy_opts(from, to, options)).await
    }
}

/// A multipart upload of which one request may fail.
#[derive(Debug)]
struct FaultUpload {
    inner: Box<dyn MultipartUpload>,
    plan: Arc<Plan>,
}

#[async_trait]
impl MultipartUpload for FaultUpload {
    fn put_part(&mut self, data: PutPayload) -> UploadPart {
        let (part, plan) = (self.inner.put_part(data), Arc::clone(&self.plan));
        async move { plan.apply("part", part).await }.boxed()
    }

    async fn complete(&mut self) -> Result<PutResult> {
        self.plan.apply("complete", self.inner.complete()).await
    }

    async fn abort(&mut self) -> Result<()> {
        self.plan.apply("abort", self.inner.abort()).await
    }
}
