//! The flags that say where a service keeps its data, the same for the service and for workers beside it.

use std::path::PathBuf;

use super::Failure;

/// Where data lie.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct StorageFlags {
    /// Folder of the service's database, uploads and files
    #[arg(long, value_name = "DIR", default_value = "tcgs-data", env = "TCGS_DATA")]
    data: PathBuf,

    /// Database, if not SQLite in the data folder
    // Shared databases and blobs come with a later version; until then they are refused rather than unknown.
    #[arg(long, value_name = "URL", env = "TCGS_DATABASE", hide = true)]
    database: Option<String>,

    /// Blob storage, if not the data folder
    #[arg(long, value_name = "URL", env = "TCGS_BLOBS", hide = true)]
    blobs: Option<String>,
}

impl StorageFlags {
    /// The data folder; what would make a queue of several machines, which this version does not have, is refused.
    pub(crate) fn folder(self) -> Result<PathBuf, Failure> {
        for (flag, value) in [("--database", self.database), ("--blobs", self.blobs)] {
            if value.is_some() {
                return Err(Failure::Usage(format!("{flag}: this version keeps SQLite and blobs in --data")));
            }
        }
        Ok(self.data)
    }
}
