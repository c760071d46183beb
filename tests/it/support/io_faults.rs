//! Calls of the operating system that fail in processes on purpose, through a library that is preloaded into them.

use std::{
    fs::File,
    io::Write as _,
    os::unix::fs::FileExt as _,
    path::{Path, PathBuf},
    process::Command,
};

use tempfile::TempDir;

use super::skip::skip;

/// An error of a file system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IoFault {
    /// The disk is full, for one call.
    Full,
    /// The disk is full from one call on.
    StaysFull,
    /// The disk fails, for one call.
    Failed,
    /// The disk only reads from one call on, as after a fault that its file system has found.
    ReadOnly,
}

impl IoFault {
    /// Error number, whether all later calls fail too, and whether reading and removing calls count.
    fn plan(self) -> (i32, bool, bool) {
        match self {
            Self::Full => (28, false, false),
            Self::StaysFull => (28, true, false),
            Self::Failed => (5, false, true),
            Self::ReadOnly => (30, true, false),
        }
    }
}

/// The library, and what it shares with the test.
pub struct IoFaults {
    plan: File,
    folder: TempDir,
}

/// Places of the numbers in the shared file.
const CALLS: u64 = 0;
const ERROR: u64 = 4;
const LASTS: u64 = 8;
const READS: u64 = 12;
const FAILED: u64 = 16;

impl IoFaults {
    /// Compiles the library; `None` without a C compiler, and then the test is skipped.
    #[track_caller]
    pub fn new() -> Option<Self> {
        let folder = tempfile::tempdir().expect("a folder");
        let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/it/support/io_fault.c");
        let library = folder.path().join("io_fault.so");
        let compiled =
            Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).args([source, "-ldl"]).status();
        let Ok(status) = compiled else {
            skip("cc is not installed");
            return None;
        };
        assert!(status.success(), "{source} does not compile");
        let path = folder.path().join("plan");
        File::create(&path).and_then(|mut file| file.write_all(&[0; 64])).expect("written");
        let plan = File::options().read(true).write(true).open(path).expect("opened");
        Some(Self { plan, folder })
    }

    /// The variables of a process whose calls on files below `root` can fail.
    pub fn variables(&self, root: &Path) -> [(&'static str, PathBuf); 3] {
        [
            ("LD_PRELOAD", self.folder.path().join("io_fault.so")),
            ("IO_FAULT_PLAN", self.folder.path().join("plan")),
            ("IO_FAULT_ROOT", root.to_owned()),
        ]
    }

    fn set(&self, place: u64, number: i32) {
        self.plan.write_all_at(&number.to_ne_bytes(), place).expect("written");
    }

    /// Lets the `call`-th call from now on fail.
    pub fn plan(&self, fault: IoFault, call: i32) {
        self.relieve();
        let (error, lasts, reads) = fault.plan();
        for (place, number) in
            [(LASTS, i32::from(lasts)), (READS, i32::from(reads)), (CALLS, call), (FAILED, 0)]
        {
            self.set(place, number);
        }
        self.set(ERROR, error);
    }

    /// Lets no call fail any more, and returns how many have.
    pub fn relieve(&self) -> i32 {
        self.set(ERROR, 0);
        let mut number = [0; 4];
        self.plan.read_exact_at(&mut number, FAILED).expect("read");
        i32::from_ne_bytes(number)
    }
}
