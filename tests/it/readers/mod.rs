//! The committed corpus through the fuzz targets of the readers, built as ever: what fuzzing once found stays mended.

mod first_files;

use std::{collections::BTreeSet, fs, path::PathBuf};

use self::first_files::first_files;

#[path = "../../../fuzz/readers.rs"]
mod targets;

type Target = (&'static str, fn(&[u8]));

/// Every target of `fuzz/readers.rs`.
const TARGETS: [Target; 10] = [
    ("ingest_zip", targets::ingest_zip),
    ("colmap_binary", targets::colmap_binary),
    ("colmap_text", targets::colmap_text),
    ("camera", targets::camera),
    ("transforms_json", targets::transforms_json),
    ("masks", targets::masks),
    ("ply", targets::ply),
    ("spz", targets::spz),
    ("view_query", targets::view_query),
    ("upload_headers", targets::upload_headers),
];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn names(folder: &str) -> BTreeSet<String> {
    fs::read_dir(root().join(folder))
        .expect("the folder is committed")
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("a name"))
        .collect()
}

#[test]
fn no_file_of_the_corpus_breaks_a_promise() {
    for (target, run) in TARGETS {
        let files = names(&format!("fuzz/corpus/{target}"));
        assert!(files.len() >= 4, "{} files for {target}", files.len());
        for file in files {
            println!("{target}/{file}");
            run(&fs::read(root().join("fuzz/corpus").join(target).join(file)).expect("readable"));
        }
    }
}

/// What a campaign of fuzzing begins with, as it is made today.
#[test]
fn first_files_break_no_promise_and_are_committed() {
    for (target, name, bytes) in first_files() {
        println!("{target}/{name}");
        let (_, run) = TARGETS.iter().find(|(name, _)| *name == target).expect("a target");
        run(&bytes);
        assert!(root().join("fuzz/corpus").join(target).join(name).is_file(), "not committed");
    }
}

#[test]
fn every_target_is_fuzzed_and_has_a_corpus_that_is_replayed() {
    let mut known: BTreeSet<String> = TARGETS.iter().map(|(name, _)| (*name).to_owned()).collect();
    // Replayed by `codec::corpus`.
    known.extend(["decode", "decode_header", "roundtrip"].map(str::to_owned));
    let sources = names("fuzz/fuzz_targets");
    let targets: BTreeSet<String> =
        sources.iter().filter_map(|name| Some(name.strip_suffix(".rs")?.to_owned())).collect();
    assert_eq!(targets, known);
    assert_eq!(names("fuzz/corpus"), known);
    let script = fs::read_to_string(root().join("scripts/fuzz.sh")).expect("the script");
    for target in known {
        assert!(
            script.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == target),
            "{target}"
        );
    }
}

/// The targets are of another workspace, which no other test compiles.
#[test]
fn the_targets_are_built_of_files_that_there_are() {
    let folder = root().join("fuzz/fuzz_targets");
    let mut paths = 0;
    for name in names("fuzz/fuzz_targets") {
        let text = fs::read_to_string(folder.join(&name)).expect("readable");
        for line in text.lines() {
            let Some(path) = line.strip_prefix("#[path = \"").and_then(|rest| rest.strip_suffix("\"]"))
            else {
                continue;
            };
            assert!(folder.join(path).is_file(), "{name}: there is no {path}");
            paths += 1;
        }
    }
    assert!(paths > 20, "{paths}");
}
