//! Committed files and their decode hashes: what was once written must be read the same for ever.
//!
//! Together they have every kind of section and every kind of context, and one of them is a scene that was trained. A change here
//! means that files in the world no longer decode, or decode to something else; raise the format's major version instead, and add
//! files of the new one beside these: `cargo run --example fixtures -- goldens FOLDER` writes them.

use std::{collections::BTreeSet, fs, path::PathBuf, process::Command};

use tcgs_codec::{
    DecodeLimits, decode,
    domain::{ContextKind, Digest},
    inspect,
};

use super::{
    dependent::KINDS,
    fixtures::{GOLDENS, UNIT},
};
use crate::skip::skip;

/// A committed file.
struct Golden {
    name: &'static str,
    /// Hash of the file.
    sha256: &'static str,
    /// Hash of its decoded attributes.
    decode_sha256: &'static str,
    anchors: usize,
}

/// Of `tcgs sample --side 40 s`, then `tcgs train s --voxel 0.5 --iterations 300 --plane-compression on --seed 3`.
const TRAINED: Golden = Golden {
    name: "trained_v1.tcgs",
    sha256: "702241f4406fa2d66a131e760597c3028b95c8b1491fa0ed2198053f6676293d",
    decode_sha256: "0a0f2c9f7aa880f38a896db02e4b2ddaa72f2b9d091e9c5a686b136ceace16ae",
    anchors: 927,
};

const FILES: [Golden; 7] = [
    Golden {
        name: "shell_v1.tcgs",
        sha256: "898ee621f1ab501991af5c1fdc22b2f5e918a8234ff9d54655c18924fab195f0",
        decode_sha256: "e27f4bd5e0657803a95a4a53821172000f1b14e857aa9cd41875756e8ba0b75a",
        anchors: 399,
    },
    Golden {
        name: "context_v1.tcgs",
        sha256: "b84445bb0067764eebacfac7d36de2dfdf2bba5664651a089ffbe047f60c1ff2",
        decode_sha256: "88337fea6b773ff00934537b2b6390790b3de3ff773891bf2a40e09efba7a62c",
        anchors: 90,
    },
    Golden {
        name: "direct_v1.tcgs",
        sha256: "b56506021496d4dbee67bd543471c49a38a1507e12fed946e8e52b56ec5db27b",
        decode_sha256: "7a0ce6c96aebe558d35a71d9a10092553ad585ae3427f509c742354971dddcb3",
        anchors: 60,
    },
    Golden {
        name: "unit_v1.tcgs",
        sha256: "ec26761570d7363f8aedb977dec0e2ccad972e1e8a5f6660cfc82bdf71cb6eba",
        decode_sha256: "ec8bf1282b00d9ad754415674c3ee3ca4dc706f44171dbf8eb2ee07ee9215969",
        anchors: 40,
    },
    Golden {
        name: "regression_v1.tcgs",
        sha256: "aa9046ebf5cd1774901439ac5e226f34554d36d57c983231522f9dd9ea924591",
        decode_sha256: "f65db9e8853f8acd8ab4c817cecdc1b44831b289e06de61a940c57c9054a3d9b",
        anchors: 120,
    },
    Golden {
        name: "regressions_v1.tcgs",
        sha256: "20e4970ba3a8a1d33f84bcd4668ed9b6fe5fc43d84b0fdffafc75634c6102fe3",
        decode_sha256: "8443018f1570e8656550f4038f0b9ff4782263164aa330ae70e955c566edaf2d",
        anchors: 150,
    },
    Golden {
        name: "harmonics_v1.tcgs",
        sha256: "fc685ec90e65535f6ec5108ff7623a26ed181569e00cd75cc41be7d4cb8e40b4",
        decode_sha256: "b002a88f377946039fc21e72048a6b5ec481f161b810022d7e235dba4483521a",
        anchors: 40,
    },
];

impl Golden {
    fn path(&self) -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(self.name)
    }

    fn bytes(&self) -> Vec<u8> {
        fs::read(self.path()).expect("the golden file is committed")
    }
}

/// The committed files, but for the trained one, which is too large to be tried in all its variations.
pub(super) fn files() -> Vec<Vec<u8>> {
    FILES.iter().map(Golden::bytes).collect()
}

#[test]
fn the_golden_files_are_the_committed_ones_and_decode_to_their_hashes() {
    for golden in FILES.iter().chain([&TRAINED]) {
        let bytes = golden.bytes();
        assert_eq!(Digest::of(&bytes).to_string(), golden.sha256, "{} was written anew", golden.name);
        let decoded = decode(&bytes, &DecodeLimits::default()).expect("decodes");
        assert_eq!(decoded.decode_sha256.to_string(), golden.decode_sha256, "{}", golden.name);
        assert_eq!(decoded.scene.len(), golden.anchors, "{}", golden.name);
        let scene_scale = if golden.name == "unit_v1.tcgs" { UNIT } else { 1.0 };
        assert_eq!(decoded.scene.scene_scale.length(), scene_scale, "{}", golden.name);
    }
}

#[test]
fn every_golden_file_is_held_here() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden");
    let entries = fs::read_dir(folder).expect("a folder");
    let found = entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("UTF-8"));
    let held = FILES.iter().chain([&TRAINED]).map(|golden| golden.name.to_owned());
    assert_eq!(found.collect::<BTreeSet<_>>(), held.collect());
}

/// `tests/oracles/decoder.py` was written from `FORMAT.md` alone.
#[test]
fn an_independent_decoder_finds_the_same_attributes() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/oracles/decoder.py");
    let golden = || FILES.iter().chain([&TRAINED]);
    let Ok(output) = Command::new("python3").arg(script).args(golden().map(Golden::path)).output() else {
        return skip("python3 is not installed");
    };
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    let expected = golden().map(|golden| format!("{} {}\n", golden.decode_sha256, golden.name));
    assert_eq!(said, expected.collect::<String>());
}

#[test]
fn the_golden_files_have_every_section_and_every_context() {
    let mut sections = BTreeSet::new();
    let mut contexts: Vec<Option<ContextKind>> = Vec::new();
    for golden in FILES {
        let inspection = inspect(&golden.bytes()).expect("inspects");
        sections.extend(inspection.sections.into_iter().map(|section| section.name));
        contexts.extend(inspection.manifest.contexts.map(|context| context.kind));
    }
    let all = [
        "manifest",
        "networks",
        "positions",
        "masks",
        "context",
        "planes",
        "regression",
        "attributes",
        "unit",
        "directions",
        "view",
    ];
    assert_eq!(sections, all.map(str::to_owned).into());
    for kind in KINDS.map(Some).into_iter().chain([None]) {
        assert!(contexts.contains(&kind), "{kind:?}");
    }
}

#[test]
fn the_encoder_still_writes_the_golden_files() {
    for (golden, (name, make)) in FILES.iter().zip(GOLDENS) {
        assert_eq!(golden.name, name);
        let encoded = make();
        assert_eq!(encoded.decode_sha256.to_string(), golden.decode_sha256, "{name}");
        assert!(encoded.bytes == golden.bytes(), "{name}: other bytes");
    }
}

/// The lines `offset: hex  meaning` of FORMAT.md's example.
#[test]
fn the_documented_example_is_a_golden_file() {
    let format = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../FORMAT.md");
    let text = fs::read_to_string(format).expect("FORMAT.md is at the root");
    let bytes = FILES[0].bytes();
    let mut lines = 0;
    for line in text.lines() {
        let Some((offset, rest)) = line.split_once(": ") else { continue };
        let Ok(offset) = usize::from_str_radix(offset, 16) else { continue };
        let hex: String = rest.split("  ").next().unwrap_or("").replace([' ', '.'], "");
        let documented: Vec<u8> = (0..hex.len() / 2)
            .map(|index| u8::from_str_radix(&hex[2 * index..2 * index + 2], 16).expect("hex"))
            .collect();
        assert_eq!(bytes[offset..offset + documented.len()], documented, "{line}");
        lines += 1;
    }
    assert!(lines >= 20, "{lines} lines");
}
