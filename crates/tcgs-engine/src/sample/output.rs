//! The folder or zip that the scene's files go into. One that is not finished leaves nothing behind.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Write as _},
    path::{Path, PathBuf},
};

use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::SampleError;

/// Files on their way to a path.
pub(super) struct Output {
    path: PathBuf,
    form: Form,
    is_finished: bool,
}

enum Form {
    /// With the files and folders that were made, in this order.
    Folder(Vec<PathBuf>),
    /// `None` once it is finished.
    Zip(Option<Box<ZipWriter<BufWriter<File>>>>),
}

impl Output {
    /// A zip if the name ends in `.zip`, else a folder.
    ///
    /// # Errors
    /// [`SampleError::Exists`], [`SampleError::NotEmpty`], [`SampleError::Io`].
    pub(super) fn create(path: &Path) -> Result<Self, SampleError> {
        let is_zip = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip"));
        let form = if is_zip { Self::zip(path)? } else { Self::folder(path)? };
        Ok(Self { path: path.to_owned(), form, is_finished: false })
    }

    fn folder(path: &Path) -> Result<Form, SampleError> {
        if path.exists() && fs::read_dir(path).map_err(io_error(path))?.next().is_some() {
            return Err(SampleError::NotEmpty(path.to_owned()));
        }
        Ok(Form::Folder(Vec::new()))
    }

    fn zip(path: &Path) -> Result<Form, SampleError> {
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(io_error(folder))?;
        }
        let file = File::create_new(path).map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => SampleError::Exists(path.to_owned()),
            _ => io_error(path)(error),
        })?;
        Ok(Form::Zip(Some(Box::new(ZipWriter::new(BufWriter::new(file))))))
    }

    /// Adds a file.
    ///
    /// # Errors
    /// [`SampleError::Io`], [`SampleError::Zip`].
    pub(super) fn write(&mut self, name: &str, bytes: &[u8]) -> Result<(), SampleError> {
        match &mut self.form {
            Form::Folder(made) => {
                let file = self.path.join(name);
                if let Some(folder) = file.parent()
                    && !folder.exists()
                {
                    fs::create_dir_all(folder).map_err(io_error(folder))?;
                    made.push(folder.to_owned());
                }
                made.push(file.clone());
                fs::write(&file, bytes).map_err(io_error(&file))
            }
            Form::Zip(None) => Ok(()),
            Form::Zip(Some(zip)) => {
                // Without times, so that its bytes depend on those of the files alone. Stored, since pictures are compressed.
                let options = SimpleFileOptions::default()
                    .compression_method(CompressionMethod::Stored)
                    .last_modified_time(zip::DateTime::default());
                zip.start_file(name, options).map_err(zip_error(&self.path))?;
                zip.write_all(bytes).map_err(io_error(&self.path))
            }
        }
    }

    /// Keeps the files.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub(super) fn finish(mut self) -> Result<(), SampleError> {
        if let Form::Zip(zip) = &mut self.form
            && let Some(zip) = zip.take()
        {
            let mut file = zip.finish().map_err(zip_error(&self.path))?;
            file.flush().map_err(io_error(&self.path))?;
        }
        self.is_finished = true;
        Ok(())
    }
}

impl Drop for Output {
    /// So that a second try, once there is room, finds the place as the first did. The first error counts.
    fn drop(&mut self) {
        if self.is_finished {
            return;
        }
        match &mut self.form {
            Form::Zip(zip) => {
                // Its own end would try to finish the file, and complain on standard error.
                std::mem::forget(zip.take());
                drop(fs::remove_file(&self.path));
            }
            Form::Folder(made) => {
                for path in made.iter().rev() {
                    drop(if path.is_dir() { fs::remove_dir(path) } else { fs::remove_file(path) });
                }
            }
        }
    }
}

fn io_error(path: &Path) -> impl FnOnce(io::Error) -> SampleError {
    let path = path.to_owned();
    move |source| SampleError::Io { path, source }
}

fn zip_error(path: &Path) -> impl FnOnce(zip::result::ZipError) -> SampleError {
    let path = path.to_owned();
    move |error| match error {
        zip::result::ZipError::Io(source) => SampleError::Io { path, source },
        error => SampleError::Zip(error),
    }
}
