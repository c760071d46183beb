//! Webhooks that fail when told to.

use std::time::Duration;

use tcgs::{
    domain::{DeliveryId, EndpointId, ProjectId},
    store::{
        DeliveryRecord, DeliveryResult, DueDelivery, EndpointRecord, NewEndpoint, Replay, StoreFuture,
        Webhooks,
    },
};

use super::FaultStore;

impl Webhooks for FaultStore {
    fn create_endpoint(&self, new: NewEndpoint, at_most: u32) -> StoreFuture<'_, Option<EndpointRecord>> {
        self.guard(self.inner.create_endpoint(new, at_most))
    }
    fn endpoint(&self, id: EndpointId) -> StoreFuture<'_, Option<EndpointRecord>> {
        self.guard(self.inner.endpoint(id))
    }
    fn endpoints(
        &self,
        project: Option<ProjectId>,
        before: Option<EndpointId>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<EndpointRecord>> {
        self.guard(self.inner.endpoints(project, before, limit))
    }
    fn delete_endpoint(&self, id: EndpointId) -> StoreFuture<'_, bool> {
        self.guard(self.inner.delete_endpoint(id))
    }
    fn deliveries(
        &self,
        endpoint: EndpointId,
        before: Option<u64>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<DeliveryRecord>> {
        self.guard(self.inner.deliveries(endpoint, before, limit))
    }
    fn replay(&self, endpoint: EndpointId, id: DeliveryId) -> StoreFuture<'_, Option<Replay>> {
        self.guard(self.inner.replay(endpoint, id))
    }
    fn take_delivery(&self, lease: Duration) -> StoreFuture<'_, Option<DueDelivery>> {
        self.guard(self.inner.take_delivery(lease))
    }
    fn finish_delivery(&self, id: DeliveryId, attempt: u32, settled: DeliveryResult) -> StoreFuture<'_, ()> {
        self.guard(self.inner.finish_delivery(id, attempt, settled))
    }
}
