//! Reads input files and writes output files atomically.

use std::{
    fs::{self, OpenOptions},
    io::{self, Write},
    path::{Path, PathBuf},
};

use tempfile::NamedTempFile;

use super::CliError;

/// Extensions of the files that commands write, and of datasets.
const OUTPUTS: [&str; 12] =
    ["tcgs", "safetensors", "ply", "spz", "glb", "usda", "sog", "zip", "png", "jpg", "jpeg", "webp"];

/// The bytes of an input file.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, CliError> {
    fs::read(path).map_err(|error| CliError::unreadable(path, &error))
}

/// Writes `bytes` to a temporary file next to `path`, syncs it and renames it. A link stays, and its file is replaced; a device or pipe is
/// written to.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), CliError> {
    let unwritable = |error: io::Error| CliError::unwritable(path, &error);
    if is_stream(path) {
        return OpenOptions::new()
            .write(true)
            .open(path)
            .and_then(|mut stream| stream.write_all(bytes))
            .map_err(unwritable);
    }
    let path = &target(path);
    let mut file = beside(path).map_err(unwritable)?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(unwritable)?;
    file.persist(path).map_err(|error| unwritable(error.error))?;
    Ok(())
}

/// Checks that `path` can be written, for commands that run for hours before they write.
pub(crate) fn check_writable(path: &Path) -> Result<(), CliError> {
    if path.is_dir() {
        return Err(CliError::unwritable(path, &io::ErrorKind::IsADirectory.into()));
    }
    if is_stream(path) {
        return Ok(());
    }
    beside(&target(path)).map(drop).map_err(|error| CliError::unwritable(path, &error))
}

/// Checks that `output` can be written, that it is not the `input`, whatever it is called, and that its extension is none of another
/// kind of file than those of `extensions`.
pub(crate) fn check_output(output: &Path, input: &Path, extensions: &[&str]) -> Result<(), CliError> {
    if let (Ok(output_file), Ok(input_file)) = (fs::canonicalize(output), fs::canonicalize(input))
        && output_file == input_file
    {
        let usage = format!("--output: {} is the input; name another file", output.display());
        return Err(CliError::Usage(usage));
    }
    let extension = output.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase());
    if let Some(extension) = extension
        && OUTPUTS.contains(&&*extension)
        && !extensions.contains(&&*extension)
    {
        let wanted = extensions.join(" or .");
        return Err(CliError::Usage(format!(
            "--output: {}: what is written is a .{wanted}",
            output.display()
        )));
    }
    check_writable(output)
}

/// The file that a link names, or the path itself.
fn target(path: &Path) -> PathBuf {
    if path.is_symlink() {
        fs::canonicalize(path).unwrap_or_else(|_| path.to_owned())
    } else {
        path.to_owned()
    }
}

/// Whether there is something at the path that has no content to be replaced: a device, a pipe or a socket.
fn is_stream(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir())
}

/// A temporary file in the folder of `path`, which is created if it is missing.
fn beside(path: &Path) -> io::Result<NamedTempFile> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    fs::create_dir_all(folder)?;
    let mut builder = tempfile::Builder::new();
    // Temporary files are private, outputs are not: these bits still pass through the process's umask.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_replace_what_was_there_and_leave_nothing_beside() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("new/out.bin");
        write(&path, b"first").expect("writes");
        write(&path, b"second").expect("writes");
        assert_eq!(fs::read(&path).expect("a file"), b"second");
        assert_eq!(fs::read_dir(path.parent().expect("a parent")).expect("a folder").count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn links_stay_and_streams_are_written_to() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (file, link) = (folder.path().join("file"), folder.path().join("link"));
        write(&file, b"old").expect("writes");
        std::os::unix::fs::symlink("file", &link).expect("a link");
        check_writable(&link).expect("writable");
        write(&link, b"new").expect("writes");
        assert!(link.is_symlink());
        assert_eq!(fs::read(&file).expect("a file"), b"new");
        // As `/dev/null` is, which must stay for the rest of the machine.
        let pipe = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo runs");
        assert!(made.success());
        check_writable(&pipe).expect("writable");
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || fs::read(pipe).expect("read")
        });
        write(&pipe, b"bytes").expect("writes");
        assert_eq!(reader.join().expect("read"), b"bytes");
        assert!(is_stream(&pipe), "it is still a pipe");
    }

    #[test]
    fn an_output_is_not_the_input_nor_called_as_another_kind_of_file() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let input = folder.path().join("scene.tcgs");
        write(&input, b"scene").expect("writes");
        let check =
            |name: &str, extensions: &[&str]| check_output(&folder.path().join(name), &input, extensions);
        for (name, extensions) in [
            ("scene.tcgs", &["tcgs"][..]),
            ("new/../scene.tcgs", &["tcgs"]),
            ("a.ply", &["spz"]),
            ("a.TCGS", &["ply"]),
        ] {
            fs::create_dir_all(folder.path().join("new")).expect("made");
            assert_eq!(check(name, extensions).expect_err(name).exit_status(), 2, "{name}");
        }
        for (name, extensions) in [
            ("other.tcgs", &["tcgs"][..]),
            ("a.compressed.ply", &["ply"]),
            ("a.bin", &["spz"]),
            ("a", &["spz"]),
        ] {
            check(name, extensions).expect(name);
        }
        assert_eq!(fs::read(&input).expect("a file"), b"scene");
    }

    #[test]
    fn trying_a_path_leaves_nothing_and_tells_what_is_in_the_way() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("out.bin");
        check_writable(&path).expect("writable");
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 0);
        write(&path, b"mine").expect("writes");
        check_writable(&path).expect("an output may be replaced");
        assert_eq!(fs::read(&path).expect("a file"), b"mine");
        for blocked in [folder.path(), &path.join("out.bin")] {
            assert_eq!(check_writable(blocked).expect_err("in the way").exit_status(), 4);
        }
    }

    #[test]
    fn faults_name_the_file() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let missing = folder.path().join("missing");
        let error = read(&missing).expect_err("there is no such file");
        assert_eq!(error.exit_status(), 3);
        assert!(error.to_string().contains("missing"));
        let error = write(folder.path(), b"x").expect_err("a folder is in the way");
        assert_eq!(error.exit_status(), 4);
    }
}
