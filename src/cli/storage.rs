//! Flags for the location of a service's data, shared by `serve` and `worker`.

use std::path::PathBuf;

use super::CliError;

/// The location of a service's data.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct StorageFlags {
    /// Folder of the service's database, uploads and files
    #[arg(long, value_name = "DIR", default_value = "tcgs-data", env = "TCGS_DATA")]
    data: PathBuf,

    /// Database, if not SQLite in the data folder
    // Fixed for scripts; shared databases and blobs are not implemented.
    #[arg(long, value_name = "URL", env = "TCGS_DATABASE", hide = true)]
    database: Option<String>,

    /// Blob storage, if not the data folder
    #[arg(long, value_name = "URL", env = "TCGS_BLOBS", hide = true)]
    blobs: Option<String>,
}

impl StorageFlags {
    /// The data folder. `--database` and `--blobs` are refused: a queue shared by machines is not implemented.
    pub(crate) fn folder(self) -> Result<PathBuf, CliError> {
        for (flag, value) in [("--database", self.database), ("--blobs", self.blobs)] {
            if value.is_some() {
                return Err(CliError::Usage(format!(
                    "{flag}: this version keeps SQLite and blobs in --data"
                )));
            }
        }
        Ok(self.data)
    }
}
