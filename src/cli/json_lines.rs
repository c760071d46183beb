//! Records of finished runs: lines of JSON in a file that survives an interruption.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
};

use serde::{Serialize, de::DeserializeOwned};
use tcgs::domain::{Problem, ProblemType};

use super::CliError;

/// Records, kept in a file as they come.
#[derive(Debug)]
pub(crate) struct JsonLines<T> {
    path: PathBuf,
    all: Vec<T>,
}

impl<T: Serialize + DeserializeOwned + Clone> JsonLines<T> {
    /// The records of the file, none if there is no file. An incomplete last line is dropped.
    pub(crate) fn open(path: &Path) -> Result<Self, CliError> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(CliError::unreadable(path, &error)),
        };
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        let all = parse(&text[..whole], path)?;
        if whole < text.len() {
            fs::write(path, &text[..whole]).map_err(|error| CliError::unwritable(path, &error))?;
        }
        Ok(Self { path: path.to_owned(), all })
    }

    /// The records of a file that must exist; it is not changed.
    pub(crate) fn read(path: &Path) -> Result<Vec<T>, CliError> {
        let text = fs::read_to_string(path).map_err(|error| CliError::unreadable(path, &error))?;
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        parse(&text[..whole], path)
    }

    /// Every record, in the order in which they came.
    pub(crate) fn all(&self) -> &[T] {
        &self.all
    }

    /// Appends one to the file and returns it as read back, so that a resumed run has the same figures to the last digit.
    pub(crate) fn add(&mut self, record: &T) -> Result<T, CliError> {
        let unwritable = |error: io::Error| CliError::unwritable(&self.path, &error);
        let mut line = serde_json::to_vec(record).map_err(|error| unwritable(error.into()))?;
        let kept: T = serde_json::from_slice(&line).map_err(|error| unwritable(error.into()))?;
        line.push(b'\n');
        let mut file =
            fs::OpenOptions::new().create(true).append(true).open(&self.path).map_err(unwritable)?;
        file.write_all(&line).and_then(|()| file.sync_all()).map_err(unwritable)?;
        self.all.push(kept.clone());
        Ok(kept)
    }
}

fn parse<T: DeserializeOwned>(lines: &str, path: &Path) -> Result<Vec<T>, CliError> {
    let mut all = Vec::new();
    for (number, line) in lines.lines().enumerate() {
        let record = serde_json::from_str(line).map_err(|error| {
            let detail = format!("line {} is not a finished run: {error}", number + 1);
            Problem::new(ProblemType::NotResults, detail).in_file(path.display().to_string())
        })?;
        all.push(record);
    }
    Ok(all)
}
