//! The model of the cameras of a dataset whose cameras were found here, apart from its photographs.

use std::{
    io::{self, Cursor, Write as _},
    path::Path,
};

use zip::{ZipWriter, result::ZipError};

use super::{
    error::{IngestError, IngestErrorKind},
    limits::Limits,
    pack::options,
    provenance::POSES_RECORD,
    tree::{Purpose, Tree},
};

/// The folder of the model.
const MODEL: &str = "sparse/0/";

/// COLMAP's model in the dataset at `path`, with the record of how it was found, as a zip archive.
///
/// # Errors
/// What cannot be read.
pub fn sparse_model(path: &Path) -> Result<Vec<u8>, IngestError> {
    let tree = Tree::open(Purpose::Load, path, &Limits::default())?;
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let unwritten = |error: ZipError| IngestErrorKind::Write(io::Error::other(error));
    for name in tree.names().filter(|name| name.starts_with(MODEL) || *name == POSES_RECORD) {
        let content = tree.read(name)?;
        archive.start_file(name, options(name, content.len() as u64)).map_err(unwritten)?;
        archive.write_all(&content).map_err(IngestErrorKind::Write)?;
    }
    Ok(archive.finish().map_err(unwritten)?.into_inner())
}
