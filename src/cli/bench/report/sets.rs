//! The datasets of a folder.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use tcgs::domain::{Problem, ProblemType};

use crate::cli::{CliError, notice::notice, reading::LENIENT, wiring};

/// The datasets of the folder by name, only those of `named` if there are any. Anything else is skipped with a note; it is wrong usage
/// to name a set in `asked` that is not there.
pub(super) fn find(
    folder: &Path,
    named: &[&str],
    asked: &[&str],
) -> Result<Vec<(String, PathBuf)>, CliError> {
    let entries = fs::read_dir(folder).map_err(|error| CliError::unreadable(folder, &error))?;
    let mut sets = BTreeMap::new();
    for entry in entries {
        let path = entry.map_err(|error| CliError::unreadable(folder, &error))?.path();
        let is_zip = path.extension().is_some_and(|extension| extension == "zip");
        if let Some(name) = path.file_stem().and_then(|name| name.to_str())
            && (path.is_dir() || is_zip)
        {
            sets.insert(name.to_owned(), path);
        }
    }
    if let Some(unknown) = asked.iter().find(|set| !sets.contains_key(**set)) {
        return Err(CliError::Usage(format!("{} has no set '{unknown}'", folder.display())));
    }
    if !named.is_empty() {
        sets.retain(|name, _| named.contains(&name.as_str()));
    }
    let mut usable = Vec::new();
    for (name, path) in sets {
        match wiring::check_dataset(&path, &LENIENT) {
            Ok(()) => usable.push((name, path)),
            Err(problem) if !named.is_empty() => return Err(problem.into()),
            Err(problem) => notice(format_args!("tcgs: note: {name} skipped: {problem}")),
        }
    }
    if usable.is_empty() {
        let problem = Problem::new(ProblemType::NoDatasets, "no dataset was found");
        return Err(problem.in_file(folder.display().to_string()).into());
    }
    Ok(usable)
}
