//! The object that says which database a bucket belongs to.
//!
//! Two databases in one bucket would remove each other's blobs. The first to come makes the object, in a request that fails if it is there.

use object_store::{ObjectStore, ObjectStoreExt as _, PutMode, PutOptions, path::Path};

use super::BlobError;

/// Its name.
const NAME: &str = "database";

fn at() -> Path {
    Path::from(NAME)
}

/// Takes the bucket for the database `identity`.
pub(super) async fn claim(objects: &dyn ObjectStore, identity: &str) -> Result<(), BlobError> {
    // Looked for first: some servers ignore the condition of the request, and would replace another database's.
    match check(objects, identity).await {
        Err(BlobError::Bucket(object_store::Error::NotFound { .. })) => {}
        known => return known,
    }
    let create = PutOptions::from(PutMode::Create);
    match objects.put_opts(&at(), identity.to_owned().into_bytes().into(), create).await {
        Ok(_) | Err(object_store::Error::AlreadyExists { .. }) => check(objects, identity).await,
        Err(error) => Err(BlobError::Bucket(error)),
    }
}

/// Refuses a bucket that the database `identity` has not taken before.
pub(super) async fn expect(objects: &dyn ObjectStore, identity: &str) -> Result<(), BlobError> {
    match check(objects, identity).await {
        Err(BlobError::Bucket(object_store::Error::NotFound { .. })) => Err(BlobError::OtherBucket),
        known => known,
    }
}

/// Takes the bucket for the database `identity`, whichever had it before.
pub(super) async fn replace(objects: &dyn ObjectStore, identity: &str) -> Result<(), BlobError> {
    let replaced = objects.put(&at(), identity.to_owned().into_bytes().into()).await;
    replaced.map(drop).map_err(BlobError::Bucket)
}

/// Whether the bucket belongs to the database `identity`.
pub(super) async fn check(objects: &dyn ObjectStore, identity: &str) -> Result<(), BlobError> {
    let found = objects.get(&at()).await.map_err(BlobError::Bucket)?;
    let found = found.bytes().await.map_err(BlobError::Bucket)?;
    if found == identity.as_bytes() { Ok(()) } else { Err(BlobError::OtherDatabase) }
}
