//! The committed corpus through the fuzz targets, built as ever: what fuzzing once found stays mended.

use std::{fs, path::PathBuf};

use super::{fixtures::corpus, wire};

#[path = "../../../../fuzz/targets.rs"]
mod targets;

fn replay(target: &str, run: fn(&[u8])) {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus").join(target);
    let mut paths: Vec<PathBuf> = fs::read_dir(&folder)
        .expect("the corpus is committed")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    paths.sort();
    assert!(paths.len() >= 10, "{} files in {}", paths.len(), folder.display());
    for path in paths {
        println!("{}", path.display());
        run(&fs::read(&path).expect("readable"));
    }
}

#[test]
fn files_of_the_corpus_break_no_promise() {
    replay("decode", targets::decode);
}

#[test]
fn headers_of_the_corpus_break_no_promise() {
    replay("decode_header", targets::decode_header);
}

#[test]
fn scenes_of_the_corpus_come_back() {
    replay("roundtrip", targets::roundtrip);
}

/// What a campaign of fuzzing begins with, as the encoder makes it today.
#[test]
fn first_files_of_the_corpus_break_no_promise() {
    for (target, name, bytes) in corpus() {
        println!("{target}/{name}");
        match target {
            "decode" => targets::decode(&bytes),
            "decode_header" => targets::decode_header(&bytes),
            "roundtrip" => targets::roundtrip(&bytes),
            other => panic!("no target {other}"),
        }
    }
}

/// Every bit of a small file, with every checksum behind it made good, those of chunks included.
#[test]
fn no_flipped_bit_behind_mended_checksums_breaks_a_promise() {
    for bytes in super::hostile::tiny_files() {
        for bit in 0..8 * bytes.len() {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            targets::decode(&damaged);
        }
    }
}
