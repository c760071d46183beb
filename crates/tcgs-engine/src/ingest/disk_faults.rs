//! Tells faults of the disk from faults of an archive, whatever the readers of its formats make of an error.
//!
//! A reader of zip, JSON or PNG reports a failed read as a fault of its input. That would refuse a good dataset, and its sender could do
//! nothing about it.

use std::{
    io::{self, Read, Seek, SeekFrom},
    sync::{Arc, Mutex, PoisonError},
};

use super::error::{IngestError, IngestErrorKind};

/// The first error of the operating system while an archive was read; clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct DiskFaults(Arc<Mutex<Option<io::Error>>>);

impl DiskFaults {
    /// The file, whose faults are kept here.
    pub(super) fn watch<F>(&self, file: F) -> WatchedFile<F> {
        WatchedFile { file, faults: self.clone() }
    }

    /// The fault of the disk, if there was one: what failed after it failed because of it. Else `error`.
    pub(super) fn or(&self, error: IngestError) -> IngestError {
        let fault = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        fault.map_or(error, |fault| IngestErrorKind::Io(fault).into())
    }

    fn keep<T>(&self, result: io::Result<T>) -> io::Result<T> {
        if let Err(error) = &result
            && let Some(code) = error.raw_os_error()
        {
            let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            kept.get_or_insert_with(|| io::Error::from_raw_os_error(code));
        }
        result
    }
}

/// A file whose faults are kept.
pub(super) struct WatchedFile<F> {
    file: F,
    faults: DiskFaults,
}

impl<F: Read> Read for WatchedFile<F> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let read = self.file.read(into);
        self.faults.keep(read)
    }
}

impl<F: Seek> Seek for WatchedFile<F> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let found = self.file.seek(to);
        self.faults.keep(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A disk that fails to be read.
    struct Broken(io::Error);

    impl Read for Broken {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(match self.0.raw_os_error() {
                Some(code) => io::Error::from_raw_os_error(code),
                None => self.0.kind().into(),
            })
        }
    }

    /// What a reader of some format makes of any error.
    fn refused() -> IngestError {
        IngestErrorKind::CorruptArchive("it cannot be read".into()).into()
    }

    #[test]
    fn a_fault_of_the_disk_is_not_the_archives() {
        let faults = DiskFaults::default();
        let read = |error| faults.watch(Broken(error)).read(&mut [0; 4]).expect_err("broken");
        read(io::ErrorKind::InvalidData.into());
        assert!(matches!(faults.or(refused()).kind, IngestErrorKind::CorruptArchive(_)));
        read(io::Error::from_raw_os_error(5));
        let IngestErrorKind::Io(error) = faults.or(refused()).kind else { panic!("the archive is blamed") };
        assert_eq!(error.raw_os_error(), Some(5));
    }
}
