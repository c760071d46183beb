//! The first key of a service that nobody can run a command in, such as a container: it comes from a file, or goes into one.
//!
//! Invariants: the key is in no log; the file is readable by its owner alone, and complete on the disk before the database knows the key, so
//! that a crash in between loses nothing. A file that holds a key is never overwritten. Of services that start together over one database,
//! one makes the first key; another that drew a key removes it from its file.

use std::{
    fs::{self, File},
    io::{self, Read as _, Write as _},
    path::Path,
};

use tcgs::{
    domain::{ApiKey, Clock as _, ProjectId, Scope, SystemClock, SystemRandom},
    store::{KeyProject, KeyRequest, NewKey, Store},
};
use tempfile::NamedTempFile;

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
    pub(super) async fn create(self, store: &Store) -> Result<(), CliError> {
        let file = self.file;
        let (key, is_drawn) = match self.key {
            Some(key) => (key, false),
            None => write_new(file)?,
        };
        let request = KeyRequest {
            name: NAME,
            scopes: &[Scope::Admin],
            project: KeyProject::Existing(ProjectId::DEFAULT),
            ..KeyRequest::default()
        };
        let new = NewKey::of(&key, &SystemRandom, SystemClock.now(), request)
            .map_err(|error| unavailable(&error))?;
        let created = store.create_first_key(new).await.map_err(|error| unavailable(&error))?;
        if let Some(record) = created {
            tracing::info!(key = %record.id, "created the first key, an administrator's; it is in {}", file.display());
            return Ok(());
        }
        tracing::info!("another service of this database has created the first key");
        let known = store.authenticate(key.hash()).await.map_err(|error| unavailable(&error))?;
        // Services on one machine may share the file, and then the other has taken the key from it.
        if is_drawn && known.is_none() {
            fs::remove_file(file).map_err(|error| CliError::unwritable(file, &error))?;
        }
        Ok(())
    }
}

/// The key in the file; `None` if there is no file, or an empty one.
fn read(path: &Path) -> Result<Option<ApiKey>, CliError> {
    let refused =
        |error: &str| CliError::Usage(format!("--bootstrap-admin-key-file: {} {error}", path.display()));
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(refused(&format!("cannot be read: {error}"))),
    };
    let mut text = String::new();
    let read = file.take(LONGEST).read_to_string(&mut text);
    read.map_err(|error| refused(&format!("cannot be read: {error}")))?;
    if text.trim().is_empty() {
        return Ok(None);
    }
    // The error does not repeat what the file holds.
    text.trim().parse().map(Some).map_err(|error| refused(&format!("holds no key: {error}")))
}

/// The key in the file, and whether it was drawn: not if another process has written one meanwhile.
fn write_new(path: &Path) -> Result<(ApiKey, bool), CliError> {
    let key = ApiKey::generate(&SystemRandom).map_err(|error| unavailable(&error))?;
    match write(path, &key) {
        Ok(()) => Ok((key, true)),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            let found = read(path)?.ok_or_else(|| CliError::unwritable(path, &error))?;
            Ok((found, false))
        }
        Err(error) => Err(CliError::unwritable(path, &error)),
    }
}

fn write(path: &Path, key: &ApiKey) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // Readable by its owner alone.
    let mut staged = NamedTempFile::new_in(folder)?;
    writeln!(staged, "{}", key.expose())?;
    staged.as_file().sync_all()?;
    // An empty file is replaced; one that holds a key was written since it was looked for.
    let is_empty = fs::metadata(path).is_ok_and(|found| found.len() == 0);
    let written = if is_empty { staged.persist(path) } else { staged.persist_noclobber(path) };
    written.map_err(|error| error.error)?;
    File::open(folder)?.sync_all()
}
