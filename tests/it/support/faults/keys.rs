//! The part that knows keys.

use tcgs::{
    domain::{KeyHash, KeyId, ProjectId},
    store::{KeyChange, KeyRecord, Keys, NewKey, StoreFuture},
};

use super::FaultStore;

impl Keys for FaultStore {
    fn create_key(&self, new: NewKey) -> StoreFuture<'_, KeyRecord> {
        self.guard(self.inner.create_key(new))
    }
    fn create_first_key(&self, new: NewKey) -> StoreFuture<'_, Option<KeyRecord>> {
        self.guard(self.inner.create_first_key(new))
    }
    fn key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>> {
        self.guard(self.inner.key(id))
    }
    fn keys(
        &self,
        project: Option<ProjectId>,
        with_revoked: bool,
        before: Option<KeyId>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<KeyRecord>> {
        self.guard(self.inner.keys(project, with_revoked, before, limit))
    }
    fn update_key(&self, id: KeyId, change: KeyChange) -> StoreFuture<'_, Option<KeyRecord>> {
        self.guard(self.inner.update_key(id, change))
    }
    fn revoke_key(&self, id: KeyId) -> StoreFuture<'_, Option<KeyRecord>> {
        self.guard(self.inner.revoke_key(id))
    }
    fn authenticate(&self, hash: KeyHash) -> StoreFuture<'_, Option<KeyRecord>> {
        self.guard(self.inner.authenticate(hash))
    }
    fn has_keys(&self) -> StoreFuture<'_, bool> {
        self.guard(self.inner.has_keys())
    }
    fn touch_key(&self, id: KeyId) -> StoreFuture<'_, ()> {
        self.guard(self.inner.touch_key(id))
    }
}
