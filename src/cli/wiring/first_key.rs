//! The first key of a service that nobody can run a command in, such as a container: it comes from a file, or goes into one.
//!
//! Invariants: the key is in no log; the file is readable by its owner alone, and complete on the disk before the database knows the key, so
//! that a crash in between loses nothing. A file that holds a key is never overwritten.

use std::{
    fs::{self, File},
    io::{self, Read as _, Write as _},
    path::Path,
};

use tcgs::{
    domain::{ApiKey, Clock as _, ProjectId, Scope, SystemClock, SystemRandom},
    store::{KeyProject, KeyRequest, Keys as _, NewKey, SqlStore},
};

use super::runtime::unavailable;
use crate::cli::CliError;

const NAME: &str = "bootstrap";

/// Longest content of a file with a key: a key, and white space around it.
const LONGEST: u64 = 1024;

/// The first key of a service that has none, with the scope `admin`.
pub(super) struct FirstKey<'a> {
    file: &'a Path,
    /// The key in the file; `None` if one is to be drawn.
    key: Option<ApiKey>,
}

impl<'a> FirstKey<'a> {
    /// What the file holds.
    pub(super) fn find(file: &'a Path) -> Result<Self, CliError> {
        Ok(Self { file, key: read(file)? })
    }

    /// Creates it, and writes it into the file if that holds none.
    pub(super) async fn create(self, store: &SqlStore) -> Result<(), CliError> {
        let key = match self.key {
            Some(key) => key,
            None => write_new(self.file)?,
        };
        let request = KeyRequest {
            name: NAME,
            scopes: &[Scope::Admin],
            project: KeyProject::Existing(ProjectId::DEFAULT),
            ..KeyRequest::default()
        };
        let new = NewKey::of(&key, &SystemRandom, SystemClock.now(), request)
            .map_err(|fault| unavailable(&fault))?;
        let record = store.create_key(new).await.map_err(|fault| unavailable(&fault))?;
        tracing::info!(key = %record.id, "created the first key, an administrator's; it is in {}", self.file.display());
        Ok(())
    }
}

/// The key in the file; `None` if there is no file, or an empty one.
fn read(path: &Path) -> Result<Option<ApiKey>, CliError> {
    let refused =
        |fault: &str| CliError::Usage(format!("--bootstrap-admin-key-file: {} {fault}", path.display()));
    let file = match File::open(path) {
        Ok(file) => file,
        Err(fault) if fault.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(fault) => return Err(refused(&format!("cannot be read: {fault}"))),
    };
    let mut text = String::new();
    let read = file.take(LONGEST).read_to_string(&mut text);
    read.map_err(|fault| refused(&format!("cannot be read: {fault}")))?;
    if text.trim().is_empty() {
        return Ok(None);
    }
    // The error does not repeat what the file holds.
    text.trim().parse().map(Some).map_err(|fault| refused(&format!("holds no key: {fault}")))
}

/// Draws a key and writes it into a new file.
fn write_new(path: &Path) -> Result<ApiKey, CliError> {
    let key = ApiKey::generate(&SystemRandom).map_err(|fault| unavailable(&fault))?;
    write(path, &key).map_err(|fault| CliError::unwritable(path, &fault))?;
    Ok(key)
}

fn write(path: &Path, key: &ApiKey) -> io::Result<()> {
    let mut name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?.to_owned();
    name.push(".new");
    let staged = path.with_file_name(name);
    let mut options = File::options();
    options.create_new(true).write(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    match fs::remove_file(&staged) {
        Err(fault) if fault.kind() != io::ErrorKind::NotFound => return Err(fault),
        _ => {}
    }
    let mut file = options.open(&staged)?;
    writeln!(file, "{}", key.expose())?;
    file.sync_all()?;
    fs::rename(&staged, path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}
