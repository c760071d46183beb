//! Flags for the location of a service's data, shared by the commands that use it.

use std::{
    fmt,
    path::{Path, PathBuf},
};

use tcgs::{
    domain::{Problem, ProblemType},
    store::{BucketUrl, DATABASE, DatabaseLocation, PostgresUrl},
};

use super::CliError;

/// The location of a service's data.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct StorageFlags {
    /// Folder of the service's files, uploads and SQLite database
    #[arg(long, global = true, value_name = "DIR", default_value = "tcgs-data", env = "TCGS_DATA")]
    data: PathBuf,

    /// PostgreSQL database instead of SQLite in the data folder: postgres://USER@HOST/DATABASE
    // A text here, so that clap repeats no password in its errors.
    #[arg(long, global = true, value_name = "URL", env = "TCGS_DATABASE", hide_env_values = true)]
    database: Option<String>,

    /// Bucket for the service's files instead of the data folder: s3://BUCKET or s3://BUCKET/PREFIX, with AWS_ACCESS_KEY_ID,
    /// AWS_SECRET_ACCESS_KEY, AWS_REGION and AWS_ENDPOINT_URL in the environment
    // A text here, so that clap repeats no key in its errors.
    #[arg(long, global = true, value_name = "URL", env = "TCGS_BLOBS", hide_env_values = true)]
    blobs: Option<String>,
}

/// Where a service's data is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Storage {
    /// The data folder.
    pub(crate) data: PathBuf,
    /// The database, if not SQLite in the data folder.
    pub(crate) database: Option<PostgresUrl>,
    /// The bucket of the service's files, if they are not in the data folder.
    pub(crate) blobs: Option<BucketUrl>,
}

impl StorageFlags {
    /// The location that the flags name.
    pub(crate) fn storage(&self) -> Result<Storage, CliError> {
        let blobs = self.blobs.as_deref().map(str::parse).transpose();
        let blobs = blobs.map_err(|error| CliError::Usage(format!("--blobs: {error}")))?;
        let database = self.database.as_deref().map(str::parse).transpose();
        let database = database.map_err(|error| CliError::Usage(format!("--database: {error}")))?;
        Ok(Storage { data: self.data.clone(), database, blobs })
    }
}

impl Storage {
    /// Where the database is.
    pub(crate) fn location(&self) -> DatabaseLocation {
        match &self.database {
            Some(url) => DatabaseLocation::Postgres(url.clone()),
            None => DatabaseLocation::File(self.data.join(DATABASE)),
        }
    }

    /// SQLite's file, unless the database is PostgreSQL, whose server is asked whether there is one.
    pub(crate) fn file(&self) -> Option<PathBuf> {
        self.database.is_none().then(|| self.data.join(DATABASE))
    }

    /// Whether the data folder is to hold a database and has none.
    pub(crate) fn lacks_database(&self) -> bool {
        self.file().is_some_and(|file| !file.exists())
    }

    /// Refuses a data folder without a database, which would otherwise be made there.
    pub(crate) fn expect_database(&self) -> Result<(), CliError> {
        if !self.lacks_database() {
            return Ok(());
        }
        let detail =
            format!("there is no database of a service in {self}; --data names the service's folder");
        Err(Problem::new(ProblemType::UnreadableInput, detail).into())
    }

    /// The data folder of a command that copies SQLite's file.
    pub(crate) fn sqlite_folder(&self, command: &str) -> Result<&Path, CliError> {
        if self.database.is_some() {
            return Err(CliError::Usage(format!(
                "--database: 'tcgs {command}' is for SQLite; use pg_dump and pg_restore for the PostgreSQL database, and copy the \
                 data folder's or the bucket's files (docs/OPERATIONS.md)"
            )));
        }
        Ok(&self.data)
    }
}

/// What holds the database: PostgreSQL's address without a password, or the data folder.
impl fmt::Display for Storage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.database {
            Some(url) => url.fmt(f),
            None => self.data.display().fmt(f),
        }
    }
}
