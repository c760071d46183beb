//! Writes the golden files, or the first files of the fuzzing corpus, into a folder: `fixtures goldens FOLDER`, `fixtures corpus FOLDER`.
//! Committed ones are never changed by it; what is new is copied beside them by hand.

#![allow(dead_code, unreachable_pub, reason = "the modules are those of the tests, which use more of them")]

use std::{fs, path::Path, process::ExitCode};

#[path = "../crates/tcgs-codec/tests/it/dependent.rs"]
mod dependent;
#[path = "../tests/it/readers/first_files.rs"]
mod first_files;
#[path = "../crates/tcgs-codec/tests/it/fixtures.rs"]
mod fixtures;
#[path = "../crates/tcgs-codec/tests/it/synthetic.rs"]
mod synthetic;
#[path = "../fuzz/readers.rs"]
mod targets;
#[path = "../crates/tcgs-codec/tests/it/wire.rs"]
mod wire;

fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    fs::create_dir_all(path.parent().unwrap_or(Path::new(".")))?;
    fs::File::create_new(path).and_then(|mut file| std::io::Write::write_all(&mut file, bytes))
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let files: Vec<(String, Vec<u8>)> = match &arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["goldens", _] => {
            fixtures::GOLDENS.iter().map(|(name, make)| ((*name).to_owned(), make().bytes)).collect()
        }
        ["corpus", _] => fixtures::corpus()
            .into_iter()
            .chain(first_files::first_files())
            .map(|(target, name, bytes)| (format!("{target}/{name}"), bytes))
            .collect(),
        _ => {
            eprintln!("fixtures goldens|corpus FOLDER");
            return ExitCode::from(2);
        }
    };
    for (name, bytes) in files {
        let path = Path::new(&arguments[1]).join(name);
        if let Err(error) = write(&path, &bytes) {
            eprintln!("{}: {error}", path.display());
            return ExitCode::FAILURE;
        }
        println!("{}: {} bytes", path.display(), bytes.len());
    }
    ExitCode::SUCCESS
}
