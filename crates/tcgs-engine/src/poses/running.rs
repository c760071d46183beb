//! A child process that ends with its owner.

use std::{
    io::{BufRead as _, BufReader},
    process::Child,
    sync::mpsc::{self, Receiver},
    thread,
};

/// A child process; it is killed where this is dropped.
pub(super) struct Running(pub(super) Child);

impl Running {
    /// The lines of its standard output, which are read on a thread of their own.
    pub(super) fn lines(&mut self) -> Receiver<String> {
        let (sender, lines) = mpsc::channel();
        if let Some(output) = self.0.stdout.take() {
            thread::spawn(move || {
                for line in BufReader::new(output).lines() {
                    if line.map_or(true, |line| sender.send(line).is_err()) {
                        break;
                    }
                }
            });
        }
        lines
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // Without effect on one that has ended.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
