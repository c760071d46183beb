//! The committed corpus through the fuzz targets, built as ever: what fuzzing once found stays mended.

use std::{fs, path::PathBuf};

use super::wire;

#[path = "../../../fuzz/targets.rs"]
mod targets;

fn replay(target: &str, run: fn(&[u8])) {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
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

/// A file as the target of headers is given it: two bytes of version, then each section's place in its list of ids,
/// length and content.
fn described(file: &[u8]) -> Option<Vec<u8>> {
    const IDS: [&[u8; 4]; 7] = [b"MANI", b"NETS", b"CELL", b"MASK", b"ATTR", b"CTXT", b"PLAN"];
    let mut bytes = vec![0, 0];
    for (id, _, content) in wire::parts(file) {
        bytes.push(IDS.iter().position(|known| **known == id)? as u8);
        bytes.push(u8::try_from(content.len()).ok().filter(|length| *length < 255)?);
        bytes.extend(content);
    }
    Some(bytes)
}

#[test]
#[ignore = "writes the first files of the corpus; what fuzzing adds is copied there by hand"]
fn make() {
    use super::synthetic::{Recipe, scene, settings, tiny};
    let write = |target: &str, name: &str, bytes: &[u8]| {
        let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
        fs::create_dir_all(&folder).expect("writable");
        fs::write(folder.join(name), bytes).expect("writable");
    };
    let mut files = vec![tcgs::codec::encode(&tiny(), None, &settings()).expect("encodes").bytes];
    for seed in 0..8 {
        let scale = seed as usize;
        let recipe = Recipe {
            seed,
            anchors: 1 + 5 * scale,
            feature_dim: 1 + scale % 3,
            offsets: 1 + scale % 4,
            masked: 0.1 * seed as f64,
        };
        files.push(tcgs::codec::encode(&scene(recipe), None, &settings()).expect("encodes").bytes);
    }
    files.extend(super::golden::files());
    files.push(super::hostile::tiny_context_file());
    for (number, file) in files.iter().enumerate() {
        write("decode", &format!("file-{number:02}"), file);
        write("decode", &format!("cut-{number:02}"), &file[..file.len() * 2 / 3]);
        if let Some(bytes) = described(file) {
            write("decode_header", &format!("file-{number:02}"), &bytes);
            write("decode_header", &format!("cut-{number:02}"), &bytes[..bytes.len() / 2]);
        }
    }
    let mut state = 1_u64;
    for number in 0..12_usize {
        let bytes: Vec<u8> = (0..40 + 150 * number)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 56) as u8
            })
            .collect();
        write("roundtrip", &format!("noise-{number:02}"), &bytes);
        write("decode_header", &format!("noise-{number:02}"), &bytes[..bytes.len().min(200)]);
    }
}
