//! The flag of the memory for views, shared by the commands that render for clients.

use tcgs::domain::Bytes;

/// How much device memory views may use.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct ViewMemoryFlag {
    /// Adapter memory for views of finished scenes, in addition to that of jobs; larger scenes are not shown
    #[arg(long, value_name = "BYTES", default_value = "2GiB", env = "TCGS_VIEW_MEMORY")]
    pub(crate) view_memory: Bytes,
}
