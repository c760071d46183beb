//! `tcgs bench report`: a matrix of runs that is killed and continued, and every file that it writes.

use std::{
    collections::BTreeSet,
    ffi::OsStr,
    fs,
    path::Path,
    process::Stdio,
    thread,
    time::{Duration, Instant},
};

use serde_json::Value;
use tcgs::sample::{self, Settings};

use crate::support::{
    program::{self, answers, tcgs},
    tree,
};

/// The matrix for tests: two models, two weights, two seeds.
const MATRIX: &str = "benches/report-small.toml";

/// Longest wait for the first run on a loaded machine.
const MAX_WAIT: Duration = Duration::from_secs(300);

fn write_set(path: &Path) {
    sample::write(path, &Settings { points: 60, ..Settings::square(16) }).expect("writes");
}

fn lines(path: &Path) -> Vec<String> {
    let text = fs::read_to_string(path).unwrap_or_default();
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    text[..whole].lines().map(str::to_owned).collect()
}

/// Arguments of a report; the folder that it writes is the last.
fn report<'a>(sets: &'a Path, matrix: &'a Path, out: &'a Path) -> Vec<&'a OsStr> {
    let [suite, matrix_flag, output] = ["--suite", "--matrix", "-o"].map(OsStr::new);
    let command = [OsStr::new("bench"), OsStr::new("report")];
    let folders = [suite, sets.as_os_str(), matrix_flag, matrix.as_os_str(), output, out.as_os_str()];
    [&command[..], &folders].concat()
}

#[test]
fn a_killed_report_goes_on_and_writes_every_table_and_chart() {
    let folder = tempfile::tempdir().expect("a folder");
    let (sets, out) = (folder.path().join("sets"), folder.path().join("out"));
    write_set(&sets.join("ball"));
    let (matrix, document) = (tree::root().join(MATRIX), folder.path().join("RESULTS.md"));
    fs::write(
        &document,
        "Prose.\n<!-- report: begin -->\nstale figures\n<!-- report: end -->\nMore prose.\n",
    )
    .expect("writes");
    let mut arguments = report(&sets, &matrix, &out);
    arguments.extend([OsStr::new("--table"), document.as_os_str(), OsStr::new("--json")]);

    let records = out.join("runs.jsonl");
    let mut first = program::command()
        .args(&arguments)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the binary runs");
    let began = Instant::now();
    while lines(&records).is_empty() && began.elapsed() < MAX_WAIT {
        assert!(first.try_wait().expect("a status").is_none_or(|status| status.success()), "it failed");
        thread::sleep(Duration::from_millis(20));
    }
    first.kill().expect("killed");
    first.wait().expect("ended");
    let kept = lines(&records);
    assert!(!kept.is_empty(), "a run is kept as it is finished");

    let answer = answers(&arguments);
    let runs = answer["runs"].as_array().expect("runs");
    let all = lines(&records);
    assert_eq!((runs.len(), all.len()), (6, 6), "3dgs, and tcgs with two weights, of two seeds");
    assert_eq!(all[..kept.len()], kept, "what was kept is not made again");
    let sessions: BTreeSet<&str> = runs.iter().filter_map(|run| run["session"].as_str()).collect();
    assert_eq!(sessions.len(), if kept.len() < 6 { 2 } else { 1 });
    for run in runs {
        check_run(run);
    }
    // Models of a seed follow one another.
    let seeds: Vec<u64> = runs.iter().filter_map(|run| run["options"]["seed"].as_u64()).collect();
    assert_eq!(seeds, [0, 0, 0, 1, 1, 1]);

    check_files(&out);
    check_document(&fs::read_to_string(&document).expect("the document"), &out);
    let page = fs::read_to_string(out.join("report.html")).expect("a page");
    let mut again = arguments.clone();
    again.push(OsStr::new("--no-runs"));
    assert_eq!(answers(&again)["runs"], answer["runs"], "nothing is made anew");
    assert_eq!(fs::read_to_string(out.join("report.html")).expect("a page"), page);

    // Another folder with the records of this one makes no run.
    let other = folder.path().join("other");
    let mut imported = again.clone();
    imported[7] = other.as_os_str();
    let import = records.as_os_str();
    imported.extend([OsStr::new("--import"), import]);
    assert_eq!(answers(&imported)["runs"], answer["runs"]);
}

fn check_run(run: &Value) {
    let metrics = &run["metrics"];
    assert!(metrics["test"]["psnr"].is_number() && metrics["rendering"]["rmse"].is_number(), "{run:#}");
    assert!(metrics["rendering"]["rmse"].as_f64().expect("a number") < 1e-3, "{run:#}");
    assert_eq!(metrics["stages"].is_null(), run["model"] == "3dgs", "{run:#}");
    if run["model"] == "tcgs" {
        // Every held-out view is measured at each stage, so that the two are one figure if it is really of floats.
        assert_eq!(metrics["psnr_before_quantisation"], metrics["stages"]["floats"], "{run:#}");
        assert_ne!(metrics["stages"]["floats"], metrics["stages"]["rounded"], "{run:#}");
    }
    assert!(run["machine"][1]["cores"].as_u64().expect("cores") >= 1, "{run:#}");
    assert!(!run["series"].as_array().expect("a series").is_empty(), "{run:#}");
    assert!(run["series"][0]["ssim"].is_number(), "{run:#}");
    assert_eq!(run["exports"][0]["format"], "spz");
    assert!(run["decode_seconds"].as_array().expect("times").len() >= 3, "{run:#}");
}

/// The tables of the report stand between the markers of a document.
fn check_document(document: &str, out: &Path) {
    assert!(document.starts_with("Prose.\n") && document.ends_with("More prose.\n"), "{document}");
    assert!(!document.contains("stale figures"));
    let tables = fs::read_to_string(out.join("report.md")).expect("the tables");
    assert!(document.contains(tables.trim()));
    for words in ["### Runs", "| ball | tcgs@0.001 | preview | 6 | 2 |", "### Where the bytes go", "llvmpipe"]
    {
        assert!(document.contains(words), "{words}: {document}");
    }
    assert!(!document.contains("LPIPS |"), "a column that nothing was measured for: {document}");
}

fn check_files(out: &Path) {
    let text =
        |name: &str| fs::read_to_string(out.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"));
    let page = text("report.html");
    for words in [
        "3dgs",
        "tcgs@0.001",
        "tcgs@0.004",
        "Runs",
        "Against the first model",
        "Quality against time",
        "Bjøntegaard",
        "Decoding",
        "Where the bytes go",
        "What each stage costs",
        "Exports",
        "without subgroups",
        "Machines and conventions",
        "±",
        "<svg",
    ] {
        assert!(page.contains(words), "{words}");
    }
    assert!(!page.contains("NaN") && !page.contains("inf<"), "{page}");
    for outside in ["<script", "<link", "<img", "src=", "href=", "@import", "url("] {
        assert!(!page.contains(outside), "the page asks for nothing: {outside}");
    }
    assert!(!page.contains("Published figures"), "the set is nobody's");
    let runs = text("runs.csv");
    assert_eq!(runs.lines().count(), 7, "{runs}");
    let survey = text("survey-ball.csv");
    assert!(survey.starts_with("Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians\n3dgs-6,"), "{survey}");
    assert_eq!(survey.lines().count(), 4, "{survey}");
    assert_eq!(text("renders.csv").lines().count(), 5, "four variants");
    for plot in
        ["psnr-seconds-ball", "ssim-seconds-ball", "psnr-bytes-ball", "decode-bytes-ball", "render-error"]
    {
        let picture = text(&format!("{plot}.svg"));
        assert!(picture.starts_with("<svg xmlns=") && picture.trim_end().ends_with("</svg>"), "{plot}");
        assert!(!picture.contains("NaN") && !picture.contains("inf"), "{plot}: {picture}");
    }
}

#[test]
fn a_set_with_a_sector_held_out_is_named_so_with_its_convention() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let (sets, out, matrix) = (at("sets"), at("out"), at("m.toml"));
    write_set(&sets.join("ball"));
    let runs = "[[runs]]\nmodels = [\"3dgs\"]\nsteps = [2]\n";
    fs::write(&matrix, format!("reference_views = 0\n{runs}{runs}sector = true\n")).expect("writes");
    let mut arguments = report(&sets, &matrix, &out);
    arguments.push(OsStr::new("--json"));
    let answer = answers(&arguments);
    let of_run = |run: usize| {
        let metrics = &answer["runs"][run]["metrics"];
        let held_out = metrics["conventions"]["held_out"].as_str().expect("a phrase");
        (held_out.to_owned(), metrics["test"]["views"].as_u64())
    };
    let (sector, views) = of_run(1);
    assert!(sector.starts_with("a sector") && views == Some(6), "{sector}, {views:?}");
    assert_ne!(of_run(0).0, sector);
    let tables = fs::read_to_string(out.join("report.md")).expect("the tables");
    assert!(tables.contains("| ball-sector | 3dgs |"), "{tables}");
    let stated =
        |set: &str| tables.lines().find(|line| line.starts_with(&format!("{set}: "))).expect("a line");
    assert!(stated("ball-sector").contains(&sector) && !stated("ball").contains(&sector), "{tables}");
}

#[test]
fn what_a_report_cannot_do_is_said_before_it_begins() {
    let folder = tempfile::tempdir().expect("a folder");
    let (sets, matrix) = (folder.path().join("sets"), folder.path().join("m.toml"));
    write_set(&sets.join("ball"));
    let document = folder.path().join("page.md");
    fs::write(&document, "no place").expect("writes");
    let refused = |text: &str, status: i32, words: &[&str]| {
        fs::write(&matrix, text).expect("writes");
        let out = folder.path().join("out");
        let mut arguments = report(&sets, &matrix, &out);
        arguments.extend([OsStr::new("--table"), document.as_os_str()]);
        let output = tcgs(arguments);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(status), "{said}");
        assert!(words.iter().all(|word| said.contains(word)), "{said}");
        assert!(!out.join("runs.jsonl").exists());
    };
    refused("[[runs]]\nmodels = [\"nerf\"]\n", 2, &["m.toml", "line 2", "nerf"]);
    refused("[[runs]]\nmodels = [\"tcgs\"]\nsets = [\"cube\"]\n", 2, &["cube"]);
    refused("[[runs]]\nmodels = [\"scaffold-wavelet\"]\n", 2, &["line 2", "only tcgs"]);
    refused("[[runs]]\nmodels = [\"tcgs\"]\nsteps = [4]\n", 3, &["page.md", "report: begin"]);
    refused("[[runs]]\nmodels = [\"tcgs\"]\n[published]\nball = \"nobody/chair\"\n", 2, &["published.ball"]);
    let missing = tcgs(["bench", "report", "--suite", "nowhere", "--matrix", "nowhere.toml"]);
    assert_eq!(missing.status.code(), Some(3), "{}", String::from_utf8_lossy(&missing.stderr));
}

/// A converter that gives back what it gets, and says that it takes 1234 bytes.
#[cfg(unix)]
fn write_converter(path: &Path) {
    let script = "#!/bin/sh\nset -e\ncp \"$1\" \"$2/same.ply\"\n\
        printf 'format\\tbytes\\tdecoded\\nsame\\t1234\\tsame.ply\\n' >\"$2/sizes.tsv\"\n";
    write_script(path, script);
}

#[cfg(unix)]
fn write_script(path: &Path, text: &str) {
    use std::os::unix::fs::PermissionsExt as _;
    fs::write(path, text).expect("writes");
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).expect("permissions");
}

#[cfg(unix)]
#[test]
fn a_run_whose_conversion_fails_is_kept_without_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let (sets, out, matrix, script) = (at("sets"), at("out"), at("m.toml"), at("convert.sh"));
    write_set(&sets.join("ball"));
    write_script(&script, "#!/bin/sh\nexit 3\n");
    let runs = "[[runs]]\nmodels = [\"3dgs\"]\nsteps = [2]\n";
    fs::write(&matrix, format!("external_formats = \"convert.sh\"\nreference_views = 0\n{runs}"))
        .expect("writes");
    let mut arguments = report(&sets, &matrix, &out);
    arguments.push(OsStr::new("--json"));
    let done = tcgs(arguments);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success() && said.contains("without other programs' formats"), "{said}");
    let done: Value = serde_json::from_slice(&done.stdout).expect("JSON");
    assert_eq!(done["runs"][0]["external_formats"], Value::Array(Vec::new()));
}

#[cfg(unix)]
#[test]
fn sizes_are_told_by_section_beside_the_baselines_and_other_formats() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let (sets, out, matrix, script) = (at("sets"), at("out"), at("m.toml"), at("convert.sh"));
    write_set(&sets.join("ball"));
    let run = || {
        let mut arguments = report(&sets, &matrix, &out);
        arguments.push(OsStr::new("--json"));
        tcgs(arguments)
    };
    let runs = "[[runs]]\nmodels = [\"3dgs\", \"scaffold\", \"tcgs\", \"tcgs-masks\"]\nsteps = [4]\n";
    fs::write(&matrix, format!("external_formats = \"convert.sh\"\nreference_views = 0\n{runs}"))
        .expect("writes");
    let failed = run();
    assert_eq!(failed.status.code(), Some(1), "{}", String::from_utf8_lossy(&failed.stderr));
    assert!(String::from_utf8_lossy(&failed.stderr).contains("convert.sh"), "a script that is not there");
    write_converter(&script);
    let done = run();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let done: Value = serde_json::from_slice(&done.stdout).expect("JSON");
    let of = |model: &str| {
        let runs = done["runs"].as_array().expect("runs");
        runs.iter().find(|run| run["model"] == model).expect("a run")
    };
    let (plain, coded) = (of("3dgs"), of("tcgs"));
    let file = &plain["external_formats"][0];
    assert_eq!((&file["format"], &file["bytes"]), (&"same".into(), &1234.into()));
    assert_eq!(file["psnr"], plain["metrics"]["test"]["psnr"], "what comes back is measured as it is");
    assert_eq!(coded["external_formats"], Value::Array(Vec::new()));
    assert!(coded["high_band"].is_number(), "{coded:#}");

    let tables = fs::read_to_string(out.join("report.md")).expect("the tables");
    let bytes = tables.split_once("### Where the bytes go").expect("the table").1;
    let cells = |line: &str| line.split('|').map(|cell| cell.trim().to_owned()).collect::<Vec<_>>();
    let head = cells(bytes.lines().nth(2).expect("a head"));
    let row = cells(bytes.lines().find(|line| line.starts_with("| ball | tcgs |")).expect("a row"));
    let at = |name: &str| &row[head.iter().position(|cell| cell == name).expect(name)];
    let counts = &coded["metrics"]["bytes"];
    for part in ["features", "scalings", "offsets", "positions", "masks", "networks"] {
        assert_eq!(*at(part), counts[part].to_string(), "{part}");
    }
    let total = |run: &Value| run["metrics"]["bytes"]["total"].as_f64().expect("bytes");
    assert_eq!(*at("bytes"), counts["total"].to_string());
    assert_eq!(*at("3dgs / it"), format!("{:.1}", total(plain) / total(coded)));
    let export = tables.lines().find(|line| line.starts_with("| ball | 3dgs | 4 | same |")).expect("a row");
    assert!(export.contains("| 1234 |"), "{export}");
}
