//! Other programs' formats for the same Gaussians: a script converts the `.ply` of 3dgs to them and back, and the result is measured
//! like every other file.
//!
//! The script gets the `.ply` and an empty folder, and writes `sizes.tsv` there with a header line and the columns `format`, `bytes` and
//! `decoded`, which names a `.ply` in the folder. `scripts/external_formats.sh` is such a script.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use tcgs::{
    domain::{Dataset, Problem, ProblemType},
    pipeline::JobOutput,
};

use tcgs_lab::report::record::ExternalFile;

use crate::cli::{CliError, files, wiring};

/// Checks that there is a script, before runs that take hours.
pub(super) fn check(script: &Path) -> Result<(), CliError> {
    let problem = |detail: String| {
        Problem::new(ProblemType::ExternalFormatsFailed, detail).in_file(script.display().to_string())
    };
    match fs::metadata(script) {
        Ok(found) if found.is_file() => Ok(()),
        Ok(_) => Err(problem("it is not a file".to_owned()).into()),
        Err(error) => Err(problem(error.to_string()).into()),
    }
}

/// The scene of a run in the formats that `script` makes, measured on the held-out views; none without a script. `open` prepares the
/// renderer of a file.
pub(super) fn measure(
    script: Option<&Path>,
    output: &JobOutput,
    dataset: &Dataset,
    open: &dyn Fn(wiring::SceneFile) -> Result<wiring::SceneViews, Problem>,
) -> Result<Vec<ExternalFile>, CliError> {
    let Some(script) = script else { return Ok(Vec::new()) };
    let folder = tempfile::tempdir().map_err(|error| CliError::unwritable(&std::env::temp_dir(), &error))?;
    let mut measured = Vec::new();
    for Converted { format, bytes, decoded } in convert(script, &output.file, folder.path())? {
        let file = wiring::read(&files::read(&decoded)?)
            .map_err(|error| error.in_file(decoded.display().to_string()))?;
        let background = output.metrics.background;
        let wiring::Measured { scores, .. } =
            wiring::score(&open(file)?, dataset, background, None, &mut |_, _, _| Ok(()))?;
        measured.push(ExternalFile { format, bytes, psnr: scores.psnr, ssim: scores.ssim });
    }
    Ok(measured)
}

/// A converted file, before it is measured.
#[derive(Debug, PartialEq)]
pub(super) struct Converted {
    pub(super) format: String,
    pub(super) bytes: u64,
    /// The `.ply` that it decodes to.
    pub(super) decoded: PathBuf,
}

/// Runs `script` on the bytes of a `.ply`; files lie in `folder`.
pub(super) fn convert(script: &Path, ply: &[u8], folder: &Path) -> Result<Vec<Converted>, CliError> {
    let (input, out) = (folder.join("input.ply"), folder.join("converted"));
    fs::write(&input, ply).map_err(|error| CliError::unwritable(&input, &error))?;
    fs::create_dir_all(&out).map_err(|error| CliError::unwritable(&out, &error))?;
    let failed = |detail: String| -> CliError {
        Problem::new(ProblemType::ExternalFormatsFailed, detail).in_file(script.display().to_string()).into()
    };
    // Standard output is this command's own.
    let status = Command::new(script)
        .args([&input, &out])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .status()
        .map_err(|error| failed(error.to_string()))?;
    if !status.success() {
        return Err(failed(format!("it ended with {status}")));
    }
    let table = out.join("sizes.tsv");
    let text = fs::read_to_string(&table).map_err(|error| CliError::unreadable(&table, &error))?;
    rows(&text, &out).map_err(|error| failed(format!("sizes.tsv: {error}")))
}

fn rows(text: &str, folder: &Path) -> Result<Vec<Converted>, String> {
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().unwrap_or_default().split('\t').collect();
    let column = |name: &str| {
        let place = header.iter().position(|known| *known == name);
        place.ok_or_else(|| format!("there is no column '{name}'"))
    };
    let (format, bytes, decoded) = (column("format")?, column("bytes")?, column("decoded")?);
    lines
        .map(|line| {
            let cells: Vec<&str> = line.split('\t').collect();
            let cell = |at: usize| cells.get(at).copied().ok_or_else(|| format!("'{line}' is cut off"));
            let bytes = cell(bytes)?;
            Ok(Converted {
                format: cell(format)?.to_owned(),
                bytes: bytes.parse().map_err(|_| format!("'{bytes}' is not a number of bytes"))?,
                decoded: folder.join(cell(decoded)?),
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name() {
        let text = "decoded\tformat\tply_bytes\tbytes\na.ply\tsog\t900\t12\nb.ply\tspz\t900\t34\n";
        let rows = rows(text, Path::new("out")).expect("rows");
        let of = |format: &str, bytes, file: &str| Converted {
            format: format.to_owned(),
            bytes,
            decoded: Path::new("out").join(file),
        };
        assert_eq!(rows, [of("sog", 12, "a.ply"), of("spz", 34, "b.ply")]);
    }

    #[test]
    fn a_table_that_is_not_one_is_named() {
        for (text, error) in [
            ("", "no column 'format'"),
            ("format\tbytes\n", "no column 'decoded'"),
            ("format\tbytes\tdecoded\nsog\tmany\ta.ply\n", "'many'"),
            ("format\tbytes\tdecoded\nsog\t7\n", "cut off"),
        ] {
            assert!(rows(text, Path::new("")).expect_err(text).contains(error), "{text}");
        }
    }
}
