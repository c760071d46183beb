//! Folder of the drivers' shader cache, which saves the next process from compiling kernels again.
//!
//! By default drivers use the user's home. The user of a service often has none, and then every process compiles anew: on Mesa's
//! software adapter, nine tenths of the time to the first training step.

use std::{
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
};

/// Variables that name the cache folder of Mesa's drivers and of NVIDIA's.
const VARIABLES: [&str; 2] = ["MESA_SHADER_CACHE_DIR", "__GL_SHADER_DISK_CACHE_PATH"];

/// Environment variables that point a child process's drivers to `folder`, if they have no cache of their own: no such variable,
/// and no writable home. `variable` reads this process's environment.
#[must_use]
pub fn driver_cache(variable: &dyn Fn(&str) -> Option<OsString>, folder: &Path) -> Vec<(OsString, OsString)> {
    if home(variable).is_some_and(|home| can_write(&home)) {
        return Vec::new();
    }
    let unset = VARIABLES.iter().filter(|name| variable(name).is_none());
    unset.map(|name| (name.into(), folder.into())).collect()
}

/// The folder that drivers use where no variable of their own names one.
fn home(variable: &dyn Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let named = |name| variable(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    named("XDG_CACHE_HOME").or_else(|| Some(named("HOME")?.join(".cache")))
}

fn can_write(folder: &Path) -> bool {
    fs::create_dir_all(folder).is_ok() && tempfile::tempfile_in(folder).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn given(variables: &[(&str, &Path)]) -> Vec<String> {
        let variables: Vec<(String, OsString)> =
            variables.iter().map(|(name, value)| ((*name).to_owned(), (*value).into())).collect();
        let read =
            |name: &str| variables.iter().find(|(known, _)| known == name).map(|(_, value)| value.clone());
        let set = driver_cache(&read, Path::new("/data/driver-cache"));
        assert!(set.iter().all(|(_, value)| value == "/data/driver-cache"));
        set.into_iter().map(|(name, _)| name.into_string().expect("a name")).collect()
    }

    #[test]
    fn a_user_without_a_home_gets_a_place_and_one_with_a_home_keeps_it() {
        let home = tempfile::tempdir().expect("a folder");
        let nowhere = home.path().join("a file");
        fs::write(&nowhere, "").expect("written");
        assert_eq!(given(&[]), VARIABLES);
        assert_eq!(given(&[("HOME", &nowhere)]), VARIABLES);
        assert_eq!(given(&[("HOME", Path::new(""))]), VARIABLES);
        assert_eq!(given(&[("HOME", home.path())]), [""; 0]);
        assert_eq!(given(&[("HOME", &nowhere), ("XDG_CACHE_HOME", home.path())]), [""; 0]);
        assert_eq!(given(&[("HOME", home.path()), ("XDG_CACHE_HOME", &nowhere)]), VARIABLES);
    }

    #[test]
    fn what_a_user_has_set_is_kept() {
        let own = Path::new("/own");
        assert_eq!(given(&[(VARIABLES[0], own)]), [VARIABLES[1]]);
        assert_eq!(given(&[(VARIABLES[0], own), (VARIABLES[1], own)]), [""; 0]);
    }
}
