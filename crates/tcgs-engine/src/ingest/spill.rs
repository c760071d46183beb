//! Photographs that exceed the memory budget: raw 8-bit samples, one after another in a temporary file.
//!
//! The file is anonymous where the system allows it and disappears with its last handle, however the process ends.

use std::{
    fs::File,
    io::{self, Read as _, Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

use super::error::{IngestErrorKind, Result};
use crate::domain::{Image, Photograph, PhotographError, PixelSource};

/// Takes photographs; the file is made for the first.
#[derive(Debug)]
pub(super) struct Spill {
    folder: PathBuf,
    file: Mutex<Option<Arc<SpillFile>>>,
}

#[derive(Debug)]
struct SpillFile {
    // One position for all: a frame is read or written in one piece, and the disk takes one at a time anyway.
    file: Mutex<Positioned>,
}

#[derive(Debug)]
struct Positioned {
    file: File,
    end: u64,
}

impl Spill {
    /// A file in `folder`, as soon as there is something to write.
    pub(super) fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), file: Mutex::default() }
    }

    /// Writes the samples of `image` and gives the handle that reads them.
    ///
    /// # Errors
    /// [`IngestErrorKind::SpillFull`] where the disk has no room left, [`IngestErrorKind::Spill`] for any other error of it.
    pub(super) fn put(&self, image: &Image) -> Result<Photograph> {
        let bytes = image.samples().len();
        let stored = self.file().and_then(|file| {
            let offset = file.append(image.samples())?;
            Ok(Stored { file, offset, bytes })
        });
        let shape = (image.width(), image.height(), image.channels());
        match stored {
            Ok(stored) => Ok(Photograph::stored(shape, Arc::new(stored))),
            Err(error) => Err(write_error(&self.folder, bytes as u64, error)),
        }
    }

    fn file(&self) -> io::Result<Arc<SpillFile>> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(file) = &*file {
            return Ok(Arc::clone(file));
        }
        let new = Arc::new(SpillFile::new(tempfile::tempfile_in(&self.folder)?));
        Ok(Arc::clone(file.insert(new)))
    }
}

/// The folder's path is for the operator: it is logged and not sent to the client.
fn write_error(folder: &Path, bytes: u64, error: io::Error) -> IngestErrorKind {
    tracing::warn!(folder = %folder.display(), %error, "photographs cannot be written to a temporary file: {error}");
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge => {
            IngestErrorKind::SpillFull { bytes }
        }
        _ => IngestErrorKind::Spill(error),
    }
}

impl SpillFile {
    fn new(file: File) -> Self {
        Self { file: Mutex::new(Positioned { file, end: 0 }) }
    }

    /// Appends and returns the offset. The next write overwrites what a failed one left.
    fn append(&self, samples: &[u8]) -> io::Result<u64> {
        let mut at = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let offset = at.end;
        at.file.seek(SeekFrom::Start(offset))?;
        at.file.write_all(samples)?;
        at.end += samples.len() as u64;
        Ok(offset)
    }

    fn read(&self, offset: u64, bytes: usize) -> io::Result<Vec<u8>> {
        let mut samples = vec![0; bytes];
        let mut at = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        at.file.seek(SeekFrom::Start(offset))?;
        at.file.read_exact(&mut samples)?;
        Ok(samples)
    }
}

/// Where one photograph's samples are.
#[derive(Debug)]
struct Stored {
    file: Arc<SpillFile>,
    offset: u64,
    bytes: usize,
}

impl PixelSource for Stored {
    fn samples(&self) -> Result<Vec<u8>, PhotographError> {
        self.file
            .read(self.offset, self.bytes)
            .map_err(|error| PhotographError::Unreadable(format!("the temporary file: {error}")))
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;

    fn image(seed: u32) -> Image {
        let (width, height) = (1 + seed % 7, 1 + seed % 5);
        let channels = 3 + (seed % 2) as u8;
        let samples = (0..width * height * u32::from(channels)).map(|i| (i * 31 + seed * 17) as u8);
        Image::new(width, height, channels, samples.collect()).expect("an image")
    }

    #[test]
    fn what_many_threads_put_away_comes_back_as_it_was() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let spill = Spill::new(folder.path());
        let put: Vec<Photograph> =
            (0..200).into_par_iter().map(|seed| spill.put(&image(seed)).expect("room")).collect();
        drop(spill);
        put.par_iter().enumerate().for_each(|(seed, photograph)| {
            assert_eq!(*photograph.load().expect("readable"), image(seed as u32));
            assert_eq!(photograph.bytes_in_memory(), 0);
        });
        drop(put);
        assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0, "nothing is left behind");
    }

    #[test]
    fn a_folder_that_is_not_there_is_an_error_that_keeps_its_name_back() {
        let folder = tempfile::tempdir().expect("a temporary folder").path().join("gone");
        let error = Spill::new(&folder).put(&image(1)).expect_err("nowhere to write");
        assert!(matches!(error, IngestErrorKind::Spill(_)) && !error.to_string().contains("gone"), "{error}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_told_apart() {
        let full = File::options().write(true).open("/dev/full").expect("the device that is always full");
        let error = SpillFile::new(full).append(&[1, 2, 3]).expect_err("no room");
        let error = write_error(Path::new("/somewhere"), 3, error);
        assert!(matches!(error, IngestErrorKind::SpillFull { bytes: 3 }), "{error}");
        assert_eq!(crate::domain::Problem::from(super::super::IngestError::from(error)).status, 507);
    }

    #[test]
    fn a_file_that_was_cut_short_is_an_error_when_it_is_read() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let spill = Spill::new(folder.path());
        let photograph = spill.put(&image(3)).expect("room");
        let file = spill.file().expect("the file");
        file.file.lock().expect("not poisoned").file.set_len(2).expect("cut");
        assert!(matches!(photograph.load(), Err(PhotographError::Unreadable(_))));
    }
}
