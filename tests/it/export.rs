//! Exports through the binary: what is written, what is said of it, and that another program reads the same.

use std::{
    collections::BTreeMap,
    ffi::OsStr,
    io::Read as _,
    path::{Path, PathBuf},
    process::Command,
};

use rand::SeedableRng;
use serde_json::{Value, json};
use tcgs::{
    domain::{AnchorScene, Background, GaussianScene, Lattice, NearPlane, SceneFrame},
    export::{PlyNote, SpzVersion, anchors, from_ply, from_spz, to_glb, to_ply, to_sog, to_spz, to_usda},
    model::{AnchorRows, ModelShape, NetworkLayout},
    sample::{self, Settings},
};

use crate::support::{
    program::{answers, succeeds, tcgs},
    server,
    shared::shared,
    skip::skip,
};

/// Arguments of several types as one line.
macro_rules! line {
    ($($argument:expr),+ $(,)?) => { vec![$(AsRef::<OsStr>::as_ref(&$argument)),+] };
}

/// A ball of anchors with networks of random weights, which depend on the view as trained ones do.
fn scene() -> AnchorScene {
    let shape = ModelShape::new(8, 3);
    let layout = NetworkLayout::new(shape);
    let networks = layout.to_networks(&layout.initial(&mut rand_pcg::Pcg64::seed_from_u64(11)));
    let cells: Vec<[i32; 3]> = (0..1000)
        .map(|i| [i % 10 - 5, i / 10 % 10 - 5, i / 100 - 5])
        .filter(|[x, y, z]| x * x + y * y + z * z < 20)
        .collect();
    let values = (0..cells.len() * shape.row())
        .map(|index| match index % shape.row() {
            // Features of both signs; sizes of some cells; offsets within a cell.
            column if column < 8 => ((index * 37) % 19) as f32 / 9.0 - 1.0,
            column if column < 14 => -2.0,
            _ => ((index * 53) % 11) as f32 / 11.0 - 0.5,
        })
        .collect();
    let masks = vec![0b111; cells.len()];
    let lattice = Lattice { voxel: 0.1, origin: [0.0; 3] };
    AnchorRows { shape, lattice, cells, values, masks }.to_scene(networks)
}

fn scene_file(folder: &Path) -> PathBuf {
    let path = folder.join("scene.safetensors");
    let bytes = anchors::write(&scene(), Background::White, None).expect("writes");
    std::fs::write(&path, bytes).expect("a folder");
    path
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn anchors_are_baked_and_the_loss_is_said_with_and_without_a_dataset() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, dataset) = (scene_file(folder.path()), folder.path().join("photographs"));
    sample::write(&dataset, &Settings { points: 300, ..Settings::square(32) }).expect("writes");
    for format in ["ply", "spz", "spz3", "glb", "usda", "sog"] {
        let out = folder.path().join(format!("out.{format}"));
        let said = answers(line!["export", file, "--format", format, "-o", out, "--json"]);
        assert_eq!((&said["format"], &said["source"]["format"]), (&format.into(), &"safetensors".into()));
        assert_eq!(said["bytes"], std::fs::metadata(&out).expect("a file").len());
        assert_eq!((&said["sh_degree"], &said["baked"]["from"]), (&3.into(), &"sphere".into()));
        let version = match format {
            "spz" => 4.into(),
            "spz3" => 3.into(),
            _ => Value::Null,
        };
        assert_eq!(said["spz"]["version"], version);
        let quality = &said["quality"];
        assert_eq!((&quality["from"], &quality["psnr_lost"]), (&"sphere".into(), &Value::Null));
        // Networks that nobody trained turn mildly with the view; a wrong frame or order of coefficients costs more.
        assert!(number(&quality["psnr_to_source"]) > 27.0, "{quality}");
        if matches!(format, "ply" | "spz" | "spz3") {
            let account = answers(line!["inspect", out, "--json"]);
            assert_eq!((&account["format"], &account["gaussians"]), (&format.into(), &said["gaussians"]));
        } else {
            assert_eq!(tcgs(line!["inspect", out]).status.code(), Some(3), "it is written, not read");
        }

        let said = answers(line![
            "export",
            file,
            "--format",
            format,
            "-o",
            out,
            "--json",
            "--dataset",
            dataset,
            "--refine",
            "0"
        ]);
        let quality = &said["quality"];
        assert_eq!(
            (&said["baked"]["from"], &quality["from"]),
            (&"training views".into(), &"held-out views".into())
        );
        let lost = number(&quality["psnr_source"]) - number(&quality["psnr"]);
        assert!((number(&quality["psnr_lost"]) - lost).abs() < 1e-9, "{quality}");
        if format == "ply" {
            // The note in the file says on what it was trained, so `eval` finds the same figure.
            let measured = answers(line!["eval", out, dataset, "--json"]);
            assert_eq!(measured["test"]["psnr"], quality["psnr"]);
        }
    }
    // A single photograph is trained on, and nothing held out.
    let matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4]];
    let table = json!({ "fl_x": 32, "frames": [{ "file_path": "a.png", "transform_matrix": matrix }] });
    let single = folder.path().join("single");
    std::fs::create_dir(&single).expect("a folder");
    std::fs::write(single.join("transforms.json"), table.to_string()).expect("writes");
    image::RgbImage::new(32, 32).save(single.join("a.png")).expect("writes");
    let out = folder.path().join("c.ply");
    let line = line!["export", file, "-o", out, "--json", "--dataset", single, "--refine", "0"];
    let said = answers(line);
    assert_eq!((&said["quality"]["from"], &said["quality"]["psnr"]), (&"sphere".into(), &Value::Null));
    assert!(number(&said["quality"]["psnr_to_source"]) > 20.0, "{}", said["quality"]);

    let text = succeeds(line!["export", file, "--format", "ply", "-o", folder.path().join("b.ply")]);
    for word in ["baked", "fidelity  PSNR", "wrote"] {
        assert!(text.contains(word), "{text}");
    }
}

#[test]
fn renders_of_the_scene_refine_what_was_baked_and_always_to_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, dataset) = (scene_file(folder.path()), folder.path().join("photographs"));
    sample::write(&dataset, &Settings { points: 300, ..Settings::square(32) }).expect("writes");
    let export = |name: &str, flags: &[&str]| {
        let out = folder.path().join(name);
        let mut line = line!["export", file, "-o", out, "--dataset", dataset, "--json"];
        line.extend(flags.iter().map(OsStr::new));
        (answers(line), std::fs::read(out).expect("a file"))
    };
    let (at_once, _) = export("a.ply", &["--refine", "0"]);
    let (refined, bytes) = export("b.ply", &[]);
    let (unmeasured, same) = export("c.ply", &["--refine", "100", "--unmeasured"]);
    assert_eq!(
        (&at_once["baked"]["refined"], &refined["baked"]["refined"]["steps"]),
        (&Value::Null, &100.into())
    );
    let [before, after] = [&at_once, &refined].map(|said| number(&said["quality"]["psnr_to_source"]));
    println!("{before} dB at once, {after} dB refined");
    assert!(after > before + 1.0, "{before} dB at once, {after} dB refined");
    assert_eq!((&at_once["gaussians"], &unmeasured["quality"]), (&refined["gaussians"], &Value::Null));
    assert!(bytes == same, "the bytes vary");
    let (cheap, _) = export("d.ply", &["--unmeasured"]);
    assert_eq!(cheap["baked"]["refined"], Value::Null, "that needs an adapter");
    let refused = tcgs(line!["export", file, "-o", folder.path().join("e.ply"), "--refine", "5"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--dataset"));
}

#[test]
fn a_compressed_file_is_exported_without_an_adapter_and_always_to_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, packed) = (scene_file(folder.path()), folder.path().join("scene.tcgs"));
    succeeds(line!["encode", file, "-o", packed]);
    let export = |name: &str| {
        let out = folder.path().join(name);
        let arguments = line![
            "export",
            packed,
            "--format",
            "ply",
            "-o",
            out,
            "--unmeasured",
            "--json",
            "--adapter",
            "no such"
        ];
        let said = answers(arguments);
        assert_eq!((&said["quality"], &said["source"]["format"]), (&Value::Null, &"tcgs".into()));
        std::fs::read(out).expect("a file")
    };
    let first = export("a.ply");
    assert!(first == export("b.ply"), "the bytes vary");
    assert_eq!(from_ply(&first).expect("a scene").degree, 3);
}

#[test]
fn plain_gaussians_go_from_one_format_to_the_other_and_lower_degrees_are_smaller() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let source = interop("gaussians.ply");
    succeeds(line!["export", source, "--format", "spz", "-o", at("a.spz"), "--unmeasured"]);
    succeeds(line!["export", source, "--format", "spz3", "-o", at("a3.spz"), "--unmeasured"]);
    succeeds(line!["export", at("a.spz"), "--format", "ply", "-o", at("a.ply"), "--unmeasured"]);
    let read = |name: &str| std::fs::read(at(name)).expect("a file");
    let (packed, back) = (from_spz(&read("a.spz")).expect("reads"), from_ply(&read("a.ply")).expect("reads"));
    assert_eq!(packed, back, "nothing is lost between a .spz and the .ply made of it");
    assert_eq!(from_spz(&read("a3.spz")).expect("reads"), packed, "the versions hold the same");
    let counts = answers(line!["inspect", at("a.spz"), "--json"])["byte_counts"].clone();
    let parts = ["positions", "features", "scalings", "container"].map(|part| number(&counts[part]));
    assert!(parts.iter().all(|bytes| *bytes > 0.0), "{counts}");
    assert_eq!(parts.iter().sum::<f64>(), read("a.spz").len() as f64);
    let said = answers(line![
        "export",
        source,
        "--format",
        "spz",
        "-o",
        at("flat.spz"),
        "--unmeasured",
        "--json",
        "--sh-degree",
        "0"
    ]);
    assert_eq!(said["sh_degree"], 0);
    assert!(read("flat.spz").len() < read("a.spz").len());
    let said = answers(line!["export", source, "--format", "spz", "-o", at("a.spz"), "--json"]);
    assert!(said["baked"].is_null());
    assert!(number(&said["quality"]["psnr_to_source"]) > 30.0, "{said}");
}

/// Views of the export from turned and scaled cameras are those of the scene, so the figures are those of an export in place.
#[test]
fn an_export_is_turned_and_scaled_and_looks_the_same_from_there() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, dataset) = (scene_file(folder.path()), folder.path().join("photographs"));
    sample::write(&dataset, &Settings { points: 300, ..Settings::square(32) }).expect("writes");
    let [whole, placed, packed] =
        ["whole.ply", "placed.ply", "placed.spz"].map(|name| folder.path().join(name));
    let in_place =
        answers(line!["export", file, "-o", whole, "--dataset", dataset, "--json", "--refine", "8"]);
    assert_eq!(in_place["placement"], Value::Null);
    for (out, lost) in [(&placed, 0.02), (&packed, 1.0)] {
        let said = answers(line![
            "export",
            file,
            "-o",
            out,
            "--dataset",
            dataset,
            "--json",
            "--refine",
            "8",
            "--up",
            "-x",
            "--scale",
            "0.01"
        ]);
        assert_eq!((&said["placement"]["up"], &said["placement"]["scale"]), (&json!("-x"), &json!(0.01)));
        let [before, after] = [&in_place, &said].map(|said| number(&said["quality"]["psnr_to_source"]));
        assert!((before - after).abs() < lost, "{before} and {after}");
    }
    let read = |path: &Path| from_ply(&std::fs::read(path).expect("a file")).expect("reads");
    let (whole, placed) = (read(&whole), read(&placed));
    // The bundled scene's upward axis is the third.
    for ([_, _, up], turned) in whole.means.iter().zip(&placed.means) {
        assert!((0.01 * up + turned[0]).abs() < 2e-4, "{up} became {turned:?}");
    }
    let output = folder.path().join("no.ply");
    for flags in [&["--up", "z"][..], &["--scale", "0"], &["--scale", "nan"]] {
        let mut arguments = line!["export", file, "-o", output];
        arguments.extend(flags.iter().map(OsStr::new));
        assert_eq!(tcgs(arguments).status.code(), Some(2), "{flags:?}");
    }
}

/// The arrays of a `.glb` by their names, as 32-bit floats.
fn glb_arrays(bytes: &[u8]) -> BTreeMap<String, Vec<f32>> {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes")) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let text = word(12);
    let document: Value = serde_json::from_slice(&bytes[20..20 + text]).expect("JSON");
    let binary = &bytes[28 + text..];
    assert_eq!(binary.len(), word(20 + text));
    let attributes = document["meshes"][0]["primitives"][0]["attributes"].as_object().expect("attributes");
    let floats = attributes.iter().filter(|(name, _)| *name != "COLOR_0").map(|(name, accessor)| {
        let accessor = &document["accessors"][accessor.as_u64().expect("an index") as usize];
        let view = &document["bufferViews"][accessor["bufferView"].as_u64().expect("an index") as usize];
        let [start, length] = ["byteOffset", "byteLength"].map(|name| view[name].as_u64().expect("a number"));
        let bytes = &binary[start as usize..(start + length) as usize];
        let values = bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        (name.clone(), values)
    });
    floats.collect()
}

#[test]
fn a_glb_and_a_usda_hold_the_floats_of_the_ply() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = from_ply(&bytes_of(interop("gaussians.ply"))).expect("a scene");
    let arrays = glb_arrays(&to_glb(&scene).expect("writes"));
    let of = |name: &str| &arrays[&format!("KHR_gaussian_splatting:{name}")];
    assert_eq!(arrays["POSITION"], scene.means.as_flattened());
    for (function, name) in ["0_COEF_0", "1_COEF_0", "1_COEF_1", "1_COEF_2", "2_COEF_0"].iter().enumerate() {
        let coefficients: Vec<f32> = scene.sh.iter().flat_map(|row| row[function]).collect();
        assert_eq!(of(&format!("SH_DEGREE_{name}")), &coefficients);
    }
    assert_eq!(arrays.len(), 4 + 16);
    for (index, opacity) in of("OPACITY").iter().enumerate() {
        let logit = f64::from(scene.opacity_logits[index]);
        assert!((f64::from(*opacity) - 1.0 / (1.0 + (-logit).exp())).abs() < 1e-7);
        for axis in 0..3 {
            let size = f64::from(scene.log_scales[index][axis]).exp();
            assert!((f64::from(of("SCALE")[3 * index + axis]) / size - 1.0).abs() < 1e-6);
        }
        let [w, x, y, z] = scene.quats[index];
        let length = (w * w + x * x + y * y + z * z).sqrt();
        for (part, value) in [x, y, z, w].into_iter().enumerate() {
            assert!((of("ROTATION")[4 * index + part] - value / length).abs() < 1e-6);
        }
    }
    let text = to_usda(&scene, None).expect("writes");
    assert!(text.starts_with("#usda 1.0\n") && text.contains("upAxis = \"Y\""), "{}", &text[..200]);
    let line = text.lines().find_map(|line| line.trim().strip_prefix("point3f[] positions = [("));
    let numbers = line.expect("positions").trim_end_matches(")]").replace("), (", ", ");
    let read: Vec<f32> = numbers.split(", ").map(|number| number.parse().expect("a float")).collect();
    assert_eq!(read, scene.means.as_flattened(), "every digit that a float has");
    let Some(python) = usd_python() else { return };
    let file = folder.path().join("scene.usda");
    std::fs::write(&file, text).expect("writes");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/read_usda.py");
    let output = Command::new(python).arg(script).arg(&file).output().expect("python runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let read: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let floats = |name: &str| -> Vec<f32> {
        read[name].as_array().expect("numbers").iter().map(|value| number(value) as f32).collect()
    };
    assert_eq!((&read["degree"], &read["up"], &read["meters"]), (&json!(3), &json!("Y"), &json!(1.0)));
    assert_eq!(floats("positions"), scene.means.as_flattened());
    assert_eq!(floats("scales"), *of("SCALE"));
    assert_eq!(floats("opacities"), *of("OPACITY"));
    assert_eq!(floats("coefficients"), scene.sh.as_flattened().as_flattened());
    assert_eq!(floats("orientations"), *of("ROTATION"), "as x, y, z, w");
}

/// A Python with `usd-core`, which `make interop` installs.
fn usd_python() -> Option<PathBuf> {
    let named = std::env::var_os("TCGS_USD_PYTHON").filter(|path| !path.is_empty()).map(PathBuf::from);
    if named.is_none() {
        skip("a Python with usd-core is not named; `make interop` installs it and runs this test");
    }
    named
}

#[test]
fn the_gaussians_that_are_shown_most_are_kept() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = scene_file(folder.path());
    let out = folder.path().join("few.ply");
    let whole = answers(line!["export", file, "-o", out, "--json", "--unmeasured"]);
    assert_eq!(whole["limited"], Value::Null);
    let mut psnr = Vec::new();
    for limit in ["100", "200"] {
        let said = answers(line!["export", file, "-o", out, "--json", "--limit-gaussians", limit]);
        assert_eq!(said["gaussians"], limit.parse::<u32>().expect("a number"));
        assert_eq!(said["limited"], json!({ "of": whole["gaussians"], "views": 96 }));
        assert_eq!(from_ply(&bytes_of(&out)).expect("a scene").len().to_string(), limit);
        psnr.push(number(&said["quality"]["psnr_to_source"]));
    }
    assert!(psnr[0] < psnr[1], "{psnr:?}");
    let refused = tcgs(line!["export", file, "-o", out, "--limit-gaussians", "0"]);
    assert_eq!(refused.status.code(), Some(2));
}

/// A `.spz` does not say from where on a scene is seen.
#[test]
fn an_export_of_a_tiny_scene_is_compared_from_its_own_near_plane() {
    const SMALLER: f32 = 0.01;
    let folder = tempfile::tempdir().expect("a folder");
    let mut scene = from_ply(&bytes_of(interop("gaussians.ply"))).expect("reads");
    scene.means.as_flattened_mut().iter_mut().for_each(|value| *value *= SMALLER);
    scene.log_scales.as_flattened_mut().iter_mut().for_each(|value| *value += SMALLER.ln());
    let note = PlyNote {
        background: Background::Black,
        dataset: None,
        near: NearPlane::of_extent(SMALLER),
        frame: SceneFrame::WORLD,
    };
    let source = folder.path().join("tiny.ply");
    std::fs::write(&source, note.add_to(to_ply(&scene))).expect("writes");
    let said = answers(line!["export", source, "-o", folder.path().join("tiny.spz"), "--json"]);
    assert!(number(&said["quality"]["psnr_to_source"]) > 25.0, "{said}");
}

#[test]
fn what_cannot_be_exported_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, out) = (scene_file(folder.path()), folder.path().join("out.ply"));
    let status = |arguments: Vec<&OsStr>| tcgs(arguments).status.code();
    let newer = folder.path().join("newer.spz");
    std::fs::write(&newer, b"NGSP\x05\0\0\0\0\0\0\0").expect("writes");
    let output = tcgs(line!["export", newer, "--format", "ply", "-o", out]);
    assert_eq!(output.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&output.stderr).contains("version 5"));
    assert_eq!(status(line!["export", file, "--format", "ply", "-o", folder.path()]), Some(4));
    assert_eq!(status(line!["export", file, "--format", "ply", "-o", out, "--dataset", "none"]), Some(3));
    assert!(!out.exists());
}

fn interop(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop").join(name)
}

fn bytes_of(path: impl AsRef<Path>) -> Vec<u8> {
    std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.as_ref().display()))
}

/// The arrays of a file of version 4, one after another.
fn arrays(bytes: &[u8]) -> Vec<u8> {
    // A frame follows the other.
    zstd::stream::decode_all(&bytes[32 + 16 * 6..]).expect("zstd")
}

/// What is in a file of gzip.
fn payload(bytes: &[u8]) -> Vec<u8> {
    let mut payload = Vec::new();
    flate2::read::GzDecoder::new(bytes).read_to_end(&mut payload).expect("gzip");
    payload
}

/// Holds two scenes to be the same up to the rounding of the formulas that both programs compute.
#[track_caller]
fn agree(ours: &GaussianScene, theirs: &GaussianScene) {
    assert_eq!(ours.len(), theirs.len());
    let near = |a: &[f32], b: &[f32], bound: f32, what: &str| {
        for (index, (a, b)) in a.iter().zip(b).enumerate() {
            assert!((a - b).abs() <= bound, "{what} {index}: {a} and {b}");
        }
    };
    near(ours.means.as_flattened(), theirs.means.as_flattened(), 1e-6, "mean");
    near(ours.log_scales.as_flattened(), theirs.log_scales.as_flattened(), 1e-6, "log-scale");
    near(&ours.opacity_logits, &theirs.opacity_logits, 1e-3, "opacity");
    near(ours.sh.as_flattened().as_flattened(), theirs.sh.as_flattened().as_flattened(), 1e-6, "harmonic");
    for (ours, theirs) in ours.quats.iter().zip(&theirs.quats) {
        let same: f32 = ours.iter().zip(theirs).map(|(a, b)| a * b).sum();
        assert!(same.abs() > 0.999_99, "rotation {ours:?} and {theirs:?}");
    }
}

#[test]
fn another_reader_reads_what_was_written_here() {
    let written = bytes_of(interop("gaussians.spz"));
    let scene = from_ply(&bytes_of(interop("gaussians.ply"))).expect("a scene");
    let three = to_spz(&scene, SpzVersion::V3).expect("packs").bytes;
    assert_eq!(payload(&three), payload(&written), "the writer has changed");
    let written_4 = bytes_of(interop("gaussians_v4.spz"));
    let four = to_spz(&scene, SpzVersion::V4).expect("packs").bytes;
    assert_eq!(
        (&four[..32], arrays(&four)),
        (&written_4[..32], arrays(&written_4)),
        "the writer has changed"
    );
    let theirs = from_ply(&bytes_of(interop("gaussians_by_splat_transform.ply"))).expect("a scene");
    agree(&from_spz(&written).expect("a scene"), &theirs);
    agree(&from_spz(&written_4).expect("a scene"), &theirs);
}

#[test]
fn another_writer_writes_the_same_integers() {
    let theirs = bytes_of(interop("spz_by_splat_transform.spz"));
    let (ours, theirs) = (payload(&bytes_of(interop("gaussians.spz"))), payload(&theirs));
    same_integers(&ours[16..], &theirs[16..]);
    assert_eq!(ours[..16], theirs[..16]);
    let theirs = bytes_of(interop("spz4_by_splat_transform.spz"));
    let ours = to_spz(&from_ply(&bytes_of(interop("gaussians.ply"))).expect("a scene"), SpzVersion::V4);
    let ours = ours.expect("packs").bytes;
    assert_eq!(ours[..32], theirs[..32]);
    same_integers(&arrays(&ours), &arrays(&theirs));
    assert_eq!(from_spz(&theirs).expect("a scene").len(), 48);
}

/// Holds the arrays of two programs against each other.
#[track_caller]
fn same_integers(ours: &[u8], theirs: &[u8]) {
    assert_eq!(ours.len(), theirs.len());
    let harmonics = (9 + 1 + 3 + 3 + 4) * 48;
    assert_eq!(ours[..harmonics], theirs[..harmonics]);
    // It rounds harmonics to 1/128 first and to 1/16 or 1/8 then, so a value in the middle may go the other way.
    let differing: Vec<(u8, u8)> = ours[harmonics..]
        .iter()
        .zip(&theirs[harmonics..])
        .map(|(a, b)| (*a, *b))
        .filter(|(a, b)| a != b)
        .collect();
    assert!(differing.len() < (ours.len() - harmonics) / 20, "{} differ", differing.len());
    assert!(differing.iter().all(|(a, b)| a.abs_diff(*b) <= 16), "{differing:?}");
}

/// The program of `make interop`, or none. The files of `tests/interop` stand in where it is not installed.
fn splat_transform() -> Option<PathBuf> {
    let named = std::env::var_os("TCGS_SPLAT_TRANSFORM").filter(|path| !path.is_empty()).map(PathBuf::from);
    if named.is_none() {
        skip("splat-transform is not named; `make interop` installs it and runs this test");
    }
    named
}

#[test]
fn splat_transform_reads_and_writes_the_same_scenes() {
    let Some(program) = splat_transform() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let convert = |from: &Path, to: &Path, more: &[&str]| {
        let status = Command::new(&program).args(["--quiet", "-w"]).arg(from).args(more).arg(to).status();
        assert!(status.expect("splat-transform runs").success());
    };
    let file = scene_file(folder.path());
    for format in ["ply", "spz", "spz3"] {
        let ours = at(&format!("ours_{format}.{}", &format[..3]));
        succeeds(line!["export", file, "--format", format, "-o", ours, "--unmeasured"]);
        let theirs = at(&format!("theirs_from_{format}.ply"));
        convert(&ours, &theirs, &[]);
        let read =
            if format == "ply" { from_ply(&bytes_of(&ours)).ok() } else { from_spz(&bytes_of(&ours)).ok() };
        agree(&read.expect("a scene"), &from_ply(&bytes_of(theirs)).expect("a scene"));
    }
    for version in ["3", "4"] {
        let (packed, back) = (at(&format!("theirs_{version}.spz")), at(&format!("back_{version}.ply")));
        convert(&at("ours_ply.ply"), &packed, &["--spz-version", version]);
        convert(&packed, &back, &[]);
        agree(&from_spz(&bytes_of(packed)).expect("a scene"), &from_ply(&bytes_of(back)).expect("a scene"));
    }
}

#[test]
fn a_sog_is_a_zip_of_lossless_pictures_in_which_the_scene_is_found_again() {
    let scene = from_ply(&bytes_of(interop("gaussians.ply"))).expect("a scene");
    let written = to_sog(&scene).expect("writes");
    assert_eq!(written.bytes, to_sog(&scene).expect("writes").bytes, "the bytes vary");
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(written.bytes)).expect("a zip");
    let mut file = |name: &str| {
        let mut bytes = Vec::new();
        zip.by_name(name).expect("a file").read_to_end(&mut bytes).expect("its bytes");
        bytes
    };
    let meta: Value = serde_json::from_slice(&file("meta.json")).expect("JSON");
    assert_eq!((&meta["version"], &meta["count"]), (&json!(2), &json!(written.scene.len())));
    let mut picture = |name: &str| server::picture(&file(name)).to_rgba8();
    let (low, high, scales) = (picture("means_l.webp"), picture("means_u.webp"), picture("scales.webp"));
    let bounds = |name: &str, axis: usize| number(&meta["means"][name][axis]);
    for (pixel, mean) in written.scene.means.iter().enumerate() {
        let at =
            |picture: &image::RgbaImage, channel: usize| f64::from(picture.as_raw()[4 * pixel + channel]);
        for axis in 0..3 {
            let share = (at(&low, axis) + 256.0 * at(&high, axis)) / 65535.0;
            let (min, max) = (bounds("mins", axis), bounds("maxs", axis));
            let logarithm = min + (max - min) * share;
            let value = logarithm.signum() * (logarithm.abs().exp() - 1.0);
            assert!((value - f64::from(mean[axis])).abs() < 1e-6, "{value} and {mean:?}");
            let scale = number(&meta["scales"]["codebook"][at(&scales, axis) as usize]);
            assert!((scale - f64::from(written.scene.log_scales[pixel][axis])).abs() < 1e-6);
        }
        let nearest = scene
            .means
            .iter()
            .map(|other| (0..3).map(|axis| (other[axis] - mean[axis]).abs()).fold(0.0_f32, f32::max));
        assert!(nearest.fold(f32::MAX, f32::min) < 1e-3, "{mean:?} is no mean of the scene");
    }
}

/// `.sog` holds what `compare` measures: the Gaussians that another program reads.
#[test]
fn splat_transform_reads_the_sog_that_is_written() {
    let Some(program) = splat_transform() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let (ours, theirs) = (folder.path().join("ours.sog"), folder.path().join("theirs.ply"));
    let file = scene_file(folder.path());
    for degree in ["0", "1", "3"] {
        let ply = folder.path().join("whole.ply");
        let arguments = line!["export", file, "-o", ply, "--unmeasured", "--sh-degree", degree];
        succeeds(arguments);
        let written = to_sog(&from_ply(&bytes_of(&ply)).expect("a scene")).expect("writes");
        std::fs::write(&ours, &written.bytes).expect("writes");
        let status = Command::new(&program).args(["--quiet", "-w"]).arg(&ours).arg(&theirs).status();
        assert!(status.expect("splat-transform runs").success());
        agree(&written.scene, &from_ply(&bytes_of(&theirs)).expect("a scene"));
    }
}

/// A `.compressed.ply` as PlayCanvas defines it: blocks of 256 Gaussians with bounds, then four words for each Gaussian.
struct CompressedPly {
    bytes: Vec<u8>,
    body: usize,
    chunks: usize,
    count: usize,
}

/// A value and how far its rounding may have moved it.
type Rounded = (f64, f64);

impl CompressedPly {
    fn open(path: &Path) -> Self {
        const END: &[u8] = b"end_header\n";
        let bytes = bytes_of(path);
        let body = bytes.windows(END.len()).position(|window| window == END).expect("a header") + END.len();
        let header = String::from_utf8_lossy(&bytes[..body]).into_owned();
        let count_of = |element: &str| -> usize {
            let line = header.lines().find_map(|line| line.strip_prefix(element)).expect("an element");
            line.trim().parse().expect("a count")
        };
        let (chunks, count) = (count_of("element chunk "), count_of("element vertex "));
        Self { bytes, body, chunks, count }
    }

    fn word(&self, at: usize) -> u32 {
        let at = self.body + 4 * at;
        u32::from_le_bytes(self.bytes[at..at + 4].try_into().expect("four bytes"))
    }

    /// One of the four words of a Gaussian.
    fn packed(&self, index: usize, which: usize) -> u32 {
        self.word(18 * self.chunks + 4 * index + which)
    }

    /// A level between the bounds of the Gaussian's block, which stand at `column` and, three columns on, at its end.
    fn between(&self, index: usize, column: usize, level: u32, levels: u32) -> Rounded {
        let bound = |column: usize| f64::from(f32::from_bits(self.word(18 * (index / 256) + column)));
        let (low, high) = (bound(column), bound(column + 3));
        let step = (high - low) / f64::from(levels);
        (low + step * f64::from(level), step / 2.0)
    }

    /// Three values in 11, 10 and 11 bits.
    fn triple(&self, index: usize, which: usize, column: usize) -> [Rounded; 3] {
        let word = self.packed(index, which);
        [(21, 2047), (11, 1023), (0, 2047)]
            .map(|(shift, levels)| (word >> shift & levels, levels))
            .into_iter()
            .zip(column..)
            .map(|((level, levels), column)| self.between(index, column, level, levels))
            .collect::<Vec<_>>()
            .try_into()
            .expect("three")
    }

    /// w, x, y, z: the largest one's place in two bits, then the others in ten each.
    fn rotation(&self, index: usize) -> [f64; 4] {
        let word = self.packed(index, 1);
        let largest = (word >> 30) as usize;
        let mut quat = [0.0; 4];
        let mut shift = 30;
        for (k, value) in quat.iter_mut().enumerate() {
            if k != largest {
                shift -= 10;
                *value = (f64::from(word >> shift & 1023) / 1023.0 - 0.5) * std::f64::consts::SQRT_2;
            }
        }
        quat[largest] = (1.0 - quat.iter().map(|value| value * value).sum::<f64>()).max(0.0).sqrt();
        quat
    }
}

#[test]
fn a_file_of_another_program_in_version_4_is_what_its_compressed_ply_is() {
    let (Some(packed), Some(other)) =
        (shared("data/interop/biker.spz"), shared("data/interop/biker.compressed.ply"))
    else {
        return;
    };
    let bytes = bytes_of(packed);
    let scene = from_spz(&bytes).expect("a scene");
    let other = CompressedPly::open(&other);
    assert_eq!((scene.len(), scene.degree, other.count), (152_746, 0, 152_746));
    let near = |index: usize, what: &str, ours: f64, rounding: f64, (theirs, theirs_rounding): Rounded| {
        let bound = (rounding + theirs_rounding) * 1.000_01 + 1e-6;
        assert!(
            (ours - theirs).abs() <= bound,
            "{what} of {index}: {ours} and {theirs}, {bound} apart at most"
        );
    };
    // The range of log-scales ends at -10 and 5.9375 in a .spz alone.
    let held = |scale: f32| scale <= -10.0 || scale >= 5.9375;
    let harmonic = 0.5 / std::f64::consts::PI.sqrt();
    for index in 0..scene.len() {
        for (ours, theirs) in scene.means[index].into_iter().zip(other.triple(index, 0, 0)) {
            near(index, "position", ours.into(), 0.5 / 4096.0, theirs);
        }
        for (ours, theirs) in scene.log_scales[index].into_iter().zip(other.triple(index, 2, 6)) {
            if !held(ours) {
                near(index, "log-scale", ours.into(), 0.5 / 16.0, theirs);
            }
        }
        let color = other.packed(index, 3);
        for (channel, ours) in scene.sh[index][0].into_iter().enumerate() {
            let theirs = other.between(index, 12 + channel, color >> (24 - 8 * channel) & 255, 255);
            near(index, "color", 0.5 + harmonic * f64::from(ours), harmonic * 0.5 / (0.15 * 255.0), theirs);
        }
        let opacity = 1.0 / (1.0 + f64::from(-scene.opacity_logits[index]).exp());
        near(index, "opacity", opacity, 0.5 / 255.0, (f64::from(color & 255) / 255.0, 0.5 / 255.0));
        let theirs = other.rotation(index);
        let same: f64 = scene.quats[index].iter().zip(theirs).map(|(a, b)| f64::from(*a) * b).sum();
        assert!(same.abs() > 1.0 - 1e-6, "rotation of {index}: {:?} and {theirs:?}", scene.quats[index]);
    }
    let again = to_spz(&scene, SpzVersion::V4).expect("packs");
    // What no pixel shows is left out: here nothing but Gaussians of opacity zero.
    assert!(again.left_out + again.gaussians == scene.len() && again.clamped == 0);
}

#[test]
fn a_crop_keeps_what_lies_in_a_box_of_the_world() {
    let folder = tempfile::tempdir().expect("a folder");
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/shell_v1.tcgs");
    let golden = golden.to_str().expect("UTF-8");
    let export = |name: &str, flags: &[&str]| {
        let out = folder.path().join(name);
        let out = out.to_str().expect("UTF-8");
        let told = answers([&["export", golden, "-o", out, "--unmeasured", "--json"], flags].concat());
        (told, from_ply(&std::fs::read(out).expect("a file")).expect("Gaussians"))
    };
    let (told, whole) = export("whole.ply", &[]);
    assert_eq!(told["cropped"], Value::Null);
    let mut across: Vec<f32> = whole.means.iter().map(|mean| mean[0]).collect();
    across.sort_unstable_by(f32::total_cmp);
    let middle = across[across.len() / 2];
    let region = format!("-1e9,-1e9,-1e9,{middle},1e9,1e9");
    let (told, cropped) = export("cropped.ply", &["--crop", &region]);
    let left: Vec<_> = whole.means.iter().filter(|mean| mean[0] <= middle).copied().collect();
    assert!(cropped.means == left && left.len() < whole.len());
    assert_eq!(told["cropped"]["removed"], whole.len() - left.len());

    let out = folder.path().join("none.ply");
    let out = out.to_str().expect("UTF-8");
    for (crop, status, named) in [
        ("cameras", 2, "--dataset"),
        ("1,1,1,0,0,0", 2, "empty along x"),
        ("everything", 2, "cameras or a box"),
        ("1e8,1e8,1e8,1e9,1e9,1e9", 3, "they lie between"),
    ] {
        let refused = tcgs(["export", golden, "-o", out, "--unmeasured", "--crop", crop]);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert_eq!(refused.status.code(), Some(status), "{crop}: {said}");
        assert!(said.contains(named), "{crop}: {said}");
    }
}

#[test]
fn a_dataset_is_read_for_an_export_as_training_read_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let (set, scene, out) = (path("set"), path("scene.tcgs"), path("scene.spz"));
    sample::write(Path::new(&set), &Settings { points: 100, ..Settings::square(16) }).expect("writes");
    // Masks that only their option finds: the left half of every photograph is ignored.
    std::fs::create_dir(path("set/people")).expect("a folder");
    for entry in std::fs::read_dir(path("set/images")).expect("photographs") {
        let name = entry.expect("a photograph").file_name();
        let mask = image::GrayImage::from_fn(16, 16, |x, _| image::Luma([if x < 8 { 0 } else { 255 }]));
        mask.save(Path::new(&path("set/people")).join(name).with_extension("png")).expect("written");
    }
    let trained = answers(["train", &set, "-o", &scene, "--iterations", "2", "--masks", "people", "--json"]);
    let told = answers(["export", &scene, "-o", &out, "--dataset", &set, "--json"]);
    let (measured, stated) = (&told["quality"]["psnr_source"], &trained["test"]["psnr"]);
    let [measured, stated] = [measured, stated].map(|psnr| psnr.as_f64().expect("a figure"));
    assert!((measured - stated).abs() < 1e-9, "{measured} where training measured {stated}");
}
