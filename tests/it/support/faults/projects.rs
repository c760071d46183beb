//! The part that knows projects.

use tcgs::{
    domain::ProjectId,
    store::{NewProject, ProjectChange, ProjectRecord, ProjectUpdate, ProjectUsage, Projects, StoreFuture},
};

use super::FaultStore;

impl Projects for FaultStore {
    fn create_project(&self, new: NewProject) -> StoreFuture<'_, ProjectRecord> {
        self.guard(self.inner.create_project(new))
    }
    fn project(&self, id: ProjectId) -> StoreFuture<'_, Option<ProjectRecord>> {
        self.guard(self.inner.project(id))
    }
    fn projects(&self, before: Option<ProjectId>, limit: u32) -> StoreFuture<'_, Vec<ProjectRecord>> {
        self.guard(self.inner.projects(before, limit))
    }
    fn update_project(
        &self,
        id: ProjectId,
        version: Option<u64>,
        change: ProjectChange,
    ) -> StoreFuture<'_, Option<ProjectUpdate>> {
        self.guard(self.inner.update_project(id, version, change))
    }
    fn project_usage(
        &self,
        project: Option<ProjectId>,
        before: Option<ProjectId>,
        limit: u32,
    ) -> StoreFuture<'_, Vec<ProjectUsage>> {
        self.guard(self.inner.project_usage(project, before, limit))
    }
}
