//! The command line as scripts see it: exit statuses, what goes to which stream, and that `--json` is pure.

use std::{
    path::Path,
    process::{Command, Output},
};

use serde_json::Value;

use crate::support::program;

const COMMANDS: [&str; 21] = [
    "keys", "submit", "watch", "fetch", "view", "jobs", "cancel", "retry", "delete", "serve", "worker",
    "train", "encode", "decode", "render", "eval", "export", "inspect", "sample", "check", "doctor",
];

/// An id that could be a job's.
const JOB: &str = "01a20055-454e-788e-bcc5-854572fb30d3";

fn tcgs(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tcgs"))
        .args(arguments)
        .env_remove("RUST_LOG")
        .env_remove("TCGS_ADAPTER")
        .env_remove("TCGS_LPIPS")
        .env_remove("TCGS_LOG_FORMAT")
        .output()
        .expect("the binary runs")
}

fn text(stream: &[u8]) -> &str {
    std::str::from_utf8(stream).expect("UTF-8")
}

/// Standard output as the one JSON document that it must be.
fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error} in standard output: {}", text(&output.stdout)))
}

fn path(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// The commands that a help lists, by the rows of its groups.
fn listed_commands(help: &str) -> Vec<&str> {
    help.lines()
        .take_while(|line| *line != "Options:")
        .filter_map(|line| line.strip_prefix("  ")?.split_whitespace().next())
        .collect()
}

#[test]
fn help_and_version_go_to_standard_output() {
    let help = tcgs(&["--help"]);
    assert_eq!(help.status.code(), Some(0));
    assert!(help.stderr.is_empty(), "{}", text(&help.stderr));
    let listed = listed_commands(text(&help.stdout));
    for command in COMMANDS {
        assert!(listed.contains(&command), "the help lists {listed:?}, without {command}");
    }
    for command in listed.into_iter().filter(|command| *command != "help") {
        let own = tcgs(&[command, "--help"]);
        assert_eq!(own.status.code(), Some(0), "{command}");
        let usage = text(&own.stdout).lines().find_map(|line| line.strip_prefix("Usage: tcgs "));
        let named = usage.and_then(|usage| usage.split_whitespace().next());
        assert_eq!(named, Some(command), "{usage:?}");
        assert!(own.stderr.is_empty(), "{command}: {}", text(&own.stderr));
    }
    let version = tcgs(&["--version"]);
    assert_eq!(text(&version.stdout), format!("tcgs {}\n", env!("CARGO_PKG_VERSION")));
    assert!(version.stderr.is_empty() && version.status.success());
}

#[test]
fn only_the_help_of_a_command_that_writes_files_speaks_of_their_names() {
    let named = "OUT.lambda-0.001.tcgs";
    for (command, writes) in [("train", true), ("submit", false)] {
        let help = tcgs(&[command, "--help"]);
        assert_eq!(text(&help.stdout).contains(named), writes, "{command}");
        assert!(text(&help.stdout).contains("--rd-curve"), "{command}");
    }
}

#[test]
fn wrong_usage_is_status_2_and_says_what_is_wrong() {
    let cases: &[(&[&str], &str)] = &[
        (&[], "Usage"),
        (&["frobnicate"], "frobnicate"),
        (&["train"], "DATASET"),
        (&["train", "d", "-o", "o", "--preset", "fast"], "preview, standard, paper"),
        (&["train", "d", "-o", "o", "--iterations", "0"], "--iterations"),
        (&["train", "d", "-o", "o", "--iterations", "-5"], "-5"),
        (&["train", "d", "-o", "o", "--model", "nerf"], "--model"),
        (&["train", "d", "-o", "o", "--voxel", "small"], "auto, published"),
        (&["train", "d", "-o", "o", "--voxel", "-1"], "--voxel"),
        (&["render", "f", "-o", "o.png"], "--pose"),
        (&["render", "f", "-o", "o.png", "--frame", "a"], "--dataset"),
        (&["render", "f", "-o", "o.png", "--pose", "{}", "--dataset", "d", "--frame", "a"], "cannot be used"),
        (&["render", "f", "-o", "o.gif", "--pose", "{}"], ".png"),
        (&["encode", "f", "-o", "o", "--feature-step", "0"], "positive"),
        (&["serve", "--listen", "nowhere"], "nowhere"),
        (&["serve", "--database", "postgres://x"], "--database"),
        (&["worker", "--blobs", "s3://x"], "--blobs"),
        (&["viewer", "--advertise", "ftp://viewer"], "--advertise"),
        (&["viewer", "--advertise", "http://viewer/?a=b"], "--advertise"),
        (&["sample", "d", "--side", "2"], "--side"),
        (&["submit", "d", "--server", "nowhere"], "--server"),
        (&["submit", "d", "--iterations", "0"], "--iterations"),
        (&["submit", "d", "--name", " "], "1 to 100 characters"),
        (&["submit", "d", "--metadata", "site"], "KEY=VALUE"),
        (&["submit", "d", "--metadata", "the site=north"], "--metadata: a key has"),
        (&["submit", "d", "--metadata", "a=1", "--metadata", "a=2"], "'a' is given twice"),
        (&["watch", "17"], "not a job id"),
        (&["fetch", "17", "-o", "o"], "not a job id"),
        (&["jobs", "--state", "queued,idle"], "'idle' is not one of queued"),
        (&["jobs", "--limit", "0"], "--limit"),
        (&["cancel", "17"], "not a job id"),
        (&["retry", JOB, "--deadline", "soon"], "--deadline"),
        (&["delete"], "JOB"),
        (&["view", JOB, "--frame", "a", "--position", "1,2,3", "-o", "o.png"], "--frame"),
        (&["view", JOB, "--position", "1,2,3", "-o", "o.png"], "--look-at"),
        (&["view", JOB, "--frame", "a", "-o", "o.gif"], ".png"),
        (&["export", "f", "-o", "o"], "--format"),
        (&["export", "f", "-o", "o", "--format", "obj"], "ply, spz, spz3, glb, usda, sog"),
        (&["export", "f", "-o", "o", "--format", "spz", "--sh-degree", "4"], "--sh-degree"),
    ];
    for (arguments, word) in cases {
        let output = tcgs(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", text(&output.stderr));
        assert!(text(&output.stderr).contains(word), "{arguments:?}: {}", text(&output.stderr));
        assert!(output.stdout.is_empty(), "{arguments:?}");
    }
}

#[test]
fn a_refused_value_of_a_variable_is_blamed_on_the_variable() {
    let serve = |flags: &[&str]| {
        let mut command = program::command();
        command.args(["serve", "--print-config"]).args(flags).env("TCGS_WORKERS", "abc");
        command.output().expect("runs")
    };
    let output = serve(&[]);
    assert_eq!(output.status.code(), Some(2));
    let said = text(&output.stderr);
    assert!(said.contains("the environment variable TCGS_WORKERS") && said.contains("'abc'"), "{said}");
    let output = serve(&["--workers", "xyz"]);
    let typed = text(&output.stderr);
    assert!(!typed.contains("TCGS_WORKERS") && typed.contains("'xyz'"), "{typed}");
}

#[test]
fn refused_input_is_status_3_and_names_the_file() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let garbage = folder.path().join("garbage.bin");
    std::fs::write(&garbage, b"neither a scene nor an archive").expect("writes");
    let garbage = path(&garbage);
    let out = |extension: &str| folder.path().join("out").with_extension(extension).display().to_string();
    let [file, picture, tensors, splats] = &["tcgs", "png", "safetensors", "spz"].map(out);
    let missing = "no/such/file";
    let cases: &[&[&str]] = &[
        &["inspect", missing],
        &["decode", missing, "-o", tensors],
        &["encode", missing, "-o", file],
        &["encode", garbage, "-o", file],
        &["export", garbage, "-o", splats, "--format", "spz"],
        &["export", garbage, "-o", splats],
        &["render", missing, "-o", picture, "--pose", missing],
        &["render", garbage, "-o", picture, "--pose", r#"{"fx": 1}"#],
        &["sample", path(folder.path())],
        &["train", "d", "-o", file, "--resume", missing],
    ];
    for arguments in cases {
        let output = tcgs(arguments);
        assert_eq!(output.status.code(), Some(3), "{arguments:?}: {}", text(&output.stderr));
        assert!(output.stdout.is_empty(), "{arguments:?}");
        assert!(text(&output.stderr).starts_with("tcgs: "), "{arguments:?}: {}", text(&output.stderr));
    }
    for out in [file, picture, tensors, splats] {
        assert!(!Path::new(out).exists(), "a failed command must leave no output");
    }
    let output = tcgs(&["inspect", missing]);
    assert!(text(&output.stderr).contains(missing));
}

#[test]
fn a_refused_dataset_is_named_and_an_output_in_the_way_is_found_before_any_work() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (archive, out) = (folder.path().join("half.zip"), folder.path().join("out.tcgs"));
    std::fs::write(&archive, b"PK\x03\x04 and then the line went dead").expect("writes");
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/shell_v1.tcgs");
    for arguments in
        [["train", path(&archive), "-o", path(&out)], ["eval", path(&golden), path(&archive), "--json"]]
    {
        let refused = tcgs(&arguments);
        assert_eq!(refused.status.code(), Some(3), "{}", text(&refused.stderr));
        assert!(text(&refused.stderr).contains("half.zip"), "{}", text(&refused.stderr));
    }
    assert!(!out.exists());
    let blocked = tcgs(&["train", path(&archive), "-o", path(&archive.join("out.tcgs"))]);
    assert_eq!(blocked.status.code(), Some(4), "{}", text(&blocked.stderr));
    assert!(text(&blocked.stderr).contains("out.tcgs"), "{}", text(&blocked.stderr));
}

#[test]
fn weights_of_lpips_are_checked_before_any_work() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let weights = folder.path().join("weights.safetensors");
    std::fs::write(&weights, b"no tensors at all").expect("writes");
    let (weights, data) = (path(&weights), folder.path().join("data"));
    let missing = "no/such/weights";
    for arguments in [
        &["train", "no/such/dataset", "-o", path(&data), "--lpips"][..],
        &["eval", "no/such/file", "no/such/dataset", "--lpips"],
        &["serve", "--listen", "127.0.0.1:0", "--data", path(&data), "--lpips"],
        &["worker", "--data", path(&data), "--lpips"],
    ] {
        for file in [weights, missing] {
            let refused = tcgs(&[arguments, &[file]].concat());
            assert_eq!(refused.status.code(), Some(3), "{arguments:?}: {}", text(&refused.stderr));
            assert!(text(&refused.stderr).contains(file), "{arguments:?}: {}", text(&refused.stderr));
        }
    }
    assert!(!data.exists(), "nothing is made before the refusal");
}

#[test]
fn with_json_a_failure_is_one_problem_document() {
    for arguments in [
        &["inspect", "no/such/file", "--json"][..],
        &["decode", "no/such/file", "-o", "x", "--json"],
        &["eval", "no/such/file", "no/such/dataset", "--json"],
        &["train", "d", "-o", "o", "--json", "--iterations", "0"],
    ] {
        let output = tcgs(arguments);
        assert_ne!(output.status.code(), Some(0), "{arguments:?}");
        let problem = json(&output);
        assert!(problem["type"].as_str().expect("a type").starts_with("urn:tcgs:problem:"), "{problem}");
        assert!(problem["detail"].is_string() && problem["status"].is_u64(), "{problem}");
        assert!(!output.stderr.is_empty(), "people read standard error: {arguments:?}");
    }
}

#[test]
fn with_json_and_all_logs_on_standard_output_is_still_one_document() {
    let doctor = |drivers: Option<&str>| {
        let mut command = program::command();
        command.args(["doctor", "--json", "--log-format", "json"]).env("RUST_LOG", "trace");
        for name in ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"] {
            drivers.map(|drivers| command.env(name, drivers));
        }
        command.output().expect("the binary runs")
    };
    let output = doctor(None);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let document = json(&output);
    let adapters = document["adapters"].as_array().expect("adapters");
    assert!(adapters.iter().any(|adapter| adapter["usable"] == true), "{document}");
    assert!(document["threads"].as_u64().expect("threads") >= 1);
    let logs = |output: &Output| -> Vec<Value> {
        let lines = text(&output.stderr).lines();
        lines.filter_map(|line| serde_json::from_str(line).ok()).collect()
    };
    let levels: Vec<Value> = logs(&output).iter().map(|entry| entry["level"].clone()).collect();
    assert!(levels.iter().any(|level| level == "DEBUG" || level == "TRACE"), "all logs are on: {levels:?}");

    // A machine without any driver of Vulkan is told so.
    let output = doctor(Some("/nonexistent/driver.json"));
    assert_eq!(output.status.code(), Some(4), "{}", text(&output.stderr));
    assert_eq!(json(&output)["type"], "urn:tcgs:problem:no-adapter");
    assert!(!logs(&output).is_empty());
}

#[test]
fn sample_writes_a_scene_that_it_will_not_overwrite() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = folder.path().join("scene");
    let arguments = ["sample", path(&scene), "--side", "16"];
    let output = tcgs(&arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(text(&output.stdout).contains("40 images to train on, 8 held out"));
    assert!(scene.join("transforms.json").is_file() && scene.join("images/view_47.png").is_file());
    assert_eq!(tcgs(&arguments).status.code(), Some(3), "a second run must refuse the folder");
}

#[test]
fn a_file_is_inspected_decoded_and_encoded_again() {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/shell_v1.tcgs");
    let size = std::fs::metadata(&golden).expect("the golden file").len();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (tensors, again) = (folder.path().join("scene.safetensors"), folder.path().join("again.tcgs"));

    let inspection = json(&tcgs(&["inspect", path(&golden), "--json"]));
    let counts = inspection["byte_counts"].as_object().expect("byte counts");
    let parts = counts.iter().filter(|(name, _)| *name != "total");
    assert_eq!(parts.map(|(_, bytes)| bytes.as_u64().expect("a count")).sum::<u64>(), size);

    let decoded = tcgs(&["decode", path(&golden), "-o", path(&tensors), "--json"]);
    assert_eq!(decoded.status.code(), Some(0), "{}", text(&decoded.stderr));
    assert_eq!(json(&decoded)["decode_sha256"], inspection["manifest"]["decode_sha256"]);

    let encoded = tcgs(&["encode", path(&tensors), "-o", path(&again)]);
    assert_eq!(encoded.status.code(), Some(0), "{}", text(&encoded.stderr));
    let anchors = json(&tcgs(&["inspect", path(&again), "--json"]))["manifest"]["anchors"].clone();
    assert_eq!(anchors, inspection["manifest"]["anchors"]);

    let cut = folder.path().join("cut.tcgs");
    std::fs::write(&cut, &std::fs::read(&golden).expect("bytes")[..1000]).expect("writes");
    let refused = tcgs(&["decode", path(&cut), "-o", path(&tensors), "--json"]);
    assert_eq!(refused.status.code(), Some(3));
    assert!(json(&refused)["file"].as_str().expect("a file").ends_with("cut.tcgs"));
}

#[test]
fn an_input_is_not_replaced_by_the_output() {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/shell_v1.tcgs");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("scene");
    std::fs::copy(&golden, &file).expect("copied");
    let scene = path(&file);
    for arguments in [
        &["decode", scene, "-o", scene][..],
        &["encode", scene, "-o", scene],
        &["export", scene, "-o", scene, "--format", "ply", "--unmeasured"],
        &["train", scene, "-o", scene],
    ] {
        let refused = tcgs(arguments);
        assert_eq!(refused.status.code(), Some(2), "{arguments:?}: {}", text(&refused.stderr));
        assert!(text(&refused.stderr).contains("is the input"), "{arguments:?}: {}", text(&refused.stderr));
    }
    assert!(std::fs::read(&file).expect("there") == std::fs::read(&golden).expect("there"));
}

#[test]
fn an_export_that_cannot_be_measured_is_not_written() {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/shell_v1.tcgs");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("scene.ply");
    let export = ["export", path(&golden), "-o", path(&out), "--adapter", "none of this name"];
    let refused = tcgs(&export);
    assert_eq!(refused.status.code(), Some(4), "{}", text(&refused.stderr));
    assert!(text(&refused.stderr).contains("--unmeasured"), "{}", text(&refused.stderr));
    assert!(!out.exists());
    let exported = tcgs(&[&export[..], &["--unmeasured"]].concat());
    assert_eq!(exported.status.code(), Some(0), "{}", text(&exported.stderr));
    assert!(std::fs::read(&out).expect("written").starts_with(b"ply"), "as its extension says");
}

#[cfg(target_os = "linux")]
#[test]
fn a_standard_error_that_takes_nothing_changes_no_outcome() {
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").expect("a full device");
    let run = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tcgs"));
        command.args(arguments).stderr(full()).output().expect("the binary runs")
    };
    let refused = run(&["inspect", "no/such/file", "--json"]);
    assert_eq!(refused.status.code(), Some(3));
    assert_eq!(json(&refused)["type"], "urn:tcgs:problem:unreadable-input");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("scene.tcgs");
    // Its first line of progress comes before anything can be wrong.
    let refused = run(&["train", "no/such/dataset", "-o", path(&out), "--json"]);
    assert_eq!(refused.status.code(), Some(3), "{}", text(&refused.stdout));
    json(&refused);
}

#[test]
fn serve_does_not_open_itself_to_the_network() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let data = folder.path().join("data");
    let output = tcgs(&["serve", "--listen", "0.0.0.0:0", "--data", path(&data)]);
    assert_eq!(output.status.code(), Some(2), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("--listen"));
    assert!(!data.exists(), "nothing is made before the refusal");
}
