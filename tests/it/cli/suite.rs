//! `tcgs eval --suite`: models side by side on small sets, tables in their place, and going on after an interruption.

use std::{ffi::OsStr, fs, path::Path};

use serde_json::Value;
use tcgs::sample::{self, Settings};

use crate::support::program::{answers, succeeds, tcgs};

/// Arguments of several types as one line.
macro_rules! line {
    ($($argument:expr),+ $(,)?) => { vec![$(AsRef::<OsStr>::as_ref(&$argument)),+] };
}

fn write_set(path: &Path) {
    sample::write(path, &Settings { side: 16, points: 60, seed: 1 }).expect("writes");
}

fn runs(report: &Value) -> Vec<(String, String, String, u64)> {
    let text = |run: &Value, name: &str| run[name].as_str().expect(name).to_owned();
    let of = |run: &Value| {
        let steps = run["metrics"]["steps"].as_u64().expect("steps");
        (text(run, "set"), text(run, "contest"), text(run, "entry"), steps)
    };
    report["runs"].as_array().expect("runs").iter().map(of).collect()
}

#[test]
fn models_are_compared_on_every_set_and_a_second_suite_only_reads() {
    let folder = tempfile::tempdir().expect("a folder");
    let sets = folder.path().join("sets");
    write_set(&sets.join("ball"));
    write_set(&sets.join("box.zip"));
    fs::create_dir(sets.join("notes")).expect("a folder that is no set");
    let (out, page) = (folder.path().join("out"), folder.path().join("RESULTS.md"));
    fs::write(&page, "Prose.\n<!-- suite: begin -->\nstale figures\n<!-- suite: end -->\nMore prose.\n")
        .expect("writes");
    let models = "3dgs,scaffold,tcgs,tcgs-wavelet";
    let arguments = line![
        "eval",
        "--suite",
        sets,
        "--models",
        models,
        "--iterations",
        "6",
        "--steps",
        "box=4",
        "--out",
        out,
        "--table",
        page,
        "--json"
    ];
    let report = answers(&arguments);

    let runs = runs(&report);
    for (set, steps) in [("ball", 6), ("box", 4)] {
        for entry in models.split(',') {
            let equal = (set.to_owned(), "steps".to_owned(), entry.to_owned(), steps);
            assert!(runs.contains(&equal), "{equal:?} of {runs:?}");
            let seconds = runs.iter().filter(|run| run.0 == set && run.1 == "seconds" && run.2 == entry);
            assert_eq!(seconds.count(), usize::from(!entry.contains('-')), "{set} {entry}");
        }
    }
    for run in report["runs"].as_array().expect("runs") {
        assert!(run["metrics"]["test"]["psnr"].is_number() && run["high_band"].is_number(), "{run:#}");
        let metrics = &run["metrics"];
        assert_eq!(metrics["anchors"] == 0, run["entry"] == "3dgs");
    }
    // The slowest model's seconds are the budget, and its own run is not made again.
    let of = |contest: &'static str| {
        let runs = report["runs"].as_array().expect("runs").iter();
        runs.filter(move |run| {
            run["set"] == "ball" && run["contest"] == contest && run["entry"] != "tcgs-wavelet"
        })
    };
    let seconds = |run: &Value| run["metrics"]["seconds"]["train"].as_f64().expect("seconds");
    let budget = of("steps").map(seconds).fold(0.0, f64::max);
    assert!(of("seconds").all(|run| run["budget"].as_f64() == Some(budget)));
    assert!(of("seconds").any(|run| seconds(run) == budget));

    let written = fs::read_to_string(&page).expect("the page");
    assert!(written.starts_with("Prose.\n") && written.ends_with("More prose.\n"), "{written}");
    assert!(!written.contains("stale figures"));
    assert!(
        written.contains("### Equal steps") && written.contains("| ball | tcgs-wavelet | 6 |"),
        "{written}"
    );
    assert!(written.contains("Adapter: "), "{written}");
    let tables = fs::read_to_string(out.join("results.md")).expect("the tables");
    assert!(written.contains(tables.trim()));

    // As if the machine had stopped in the middle of writing a line.
    let kept = out.join("runs.jsonl");
    let before = fs::read_to_string(&kept).expect("the runs");
    fs::write(&kept, format!("{before}{{\"set\": \"ba")).expect("writes");
    let again = answers(&arguments);
    assert_eq!(again, report, "nothing is trained again");
    assert_eq!(fs::read_to_string(&kept).expect("the runs"), before);
}

/// A converter that gives back what it gets, and says that it takes 1234 bytes.
#[cfg(unix)]
fn write_converter(path: &Path) {
    use std::os::unix::fs::PermissionsExt as _;
    let script = "#!/bin/sh\nset -e\ncp \"$1\" \"$2/same.ply\"\n\
        printf 'format\\tbytes\\tdecoded\\nsame\\t1234\\tsame.ply\\n' >\"$2/sizes.tsv\"\n";
    fs::write(path, script).expect("writes");
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).expect("permissions");
}

#[cfg(unix)]
#[test]
fn sizes_are_told_by_section_beside_the_baselines_and_other_formats() {
    let folder = tempfile::tempdir().expect("a folder");
    let (sets, out) = (folder.path().join("sets"), folder.path().join("out"));
    write_set(&sets.join("ball"));
    let script = folder.path().join("convert.sh");
    let suite = |models: &str, convert: bool| {
        let mut arguments =
            line!["eval", "--suite", sets, "--models", models, "--iterations", "4", "--out", out, "--json"]
                .into_iter()
                .map(OsStr::to_owned)
                .collect::<Vec<_>>();
        arguments.push("--steps-only".into());
        if convert {
            arguments.extend(["--external-formats".into(), script.clone().into()]);
        }
        arguments
    };
    answers(suite("3dgs", false));
    let models = "3dgs,scaffold,tcgs,tcgs-masks";
    let failed = tcgs(suite(models, true));
    assert_eq!(failed.status.code(), Some(1), "{}", String::from_utf8_lossy(&failed.stderr));
    assert!(String::from_utf8_lossy(&failed.stderr).contains("convert.sh"), "a script that is not there");
    write_converter(&script);
    let report = answers(suite(models, true));

    let runs = report["runs"].as_array().expect("runs");
    let of = |entry: &str| runs.iter().find(|run| run["entry"] == entry).expect("a run");
    let (plain, tcgs) = (of("3dgs"), of("tcgs"));
    let file = &plain["peers"][0];
    assert_eq!((&file["format"], &file["bytes"]), (&"same".into(), &1234.into()));
    assert_eq!(file["psnr"], plain["metrics"]["test"]["psnr"], "what comes back is measured as it is");
    assert_eq!(tcgs["peers"], Value::Array(Vec::new()));

    let tables = fs::read_to_string(out.join("results.md")).expect("the tables");
    let row = |start: &str| {
        let line = tables.lines().find(|line| line.starts_with(start)).expect(start);
        line.split('|').map(|cell| cell.trim().to_owned()).collect::<Vec<_>>()
    };
    let bytes = tables.split_once("### Bytes by section").expect("the table").1;
    let head: Vec<&str> = bytes.lines().nth(2).expect("a head").split('|').map(str::trim).collect();
    let line = bytes.lines().find(|line| line.starts_with("| ball | tcgs |")).expect("a row");
    let cells: Vec<&str> = line.split('|').map(str::trim).collect();
    let at = |name: &str| cells[head.iter().position(|cell| *cell == name).expect(name)];
    let counts = &tcgs["metrics"]["bytes"];
    for part in ["features", "scalings", "offsets", "positions", "masks", "networks", "total"] {
        assert_eq!(at(part), counts[part].to_string(), "{part}");
    }
    let total = |run: &Value| run["metrics"]["bytes"]["total"].as_f64().expect("bytes");
    assert_eq!(at("3dgs / it"), format!("{:.1}", total(plain) / total(tcgs)));
    assert_eq!(row("| ball | 3dgs as same |")[3], "1234");
}

#[test]
fn what_a_suite_cannot_do_is_said_before_it_begins() {
    let folder = tempfile::tempdir().expect("a folder");
    let sets = folder.path().join("sets");
    fs::create_dir_all(&sets).expect("a folder");
    let out = folder.path().join("out");
    let refused = |more: &[&str], status: i32, word: &str| {
        let mut arguments = line!["eval", "--suite", sets, "--out", out];
        arguments.extend(more.iter().map(OsStr::new));
        let output = tcgs(&arguments);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(status), "{said}");
        assert!(said.contains(word), "{said}");
    };
    refused(&[], 3, "no dataset");
    write_set(&sets.join("ball"));
    refused(&["--models", "nerf"], 2, "nerf");
    refused(&["--models", "scaffold-wavelet"], 2, "only tcgs");
    refused(&["--steps", "ball"], 2, "SET=STEPS");
    refused(&["--steps", "cube=4"], 2, "cube");
    refused(&["--sets", "cube"], 2, "cube");
    refused(&["--iterations", "0"], 2, "iterations");
    refused(&["file.tcgs", "dataset"], 2, "cannot be used");
    let page = folder.path().join("page.md");
    fs::write(&page, "no place").expect("writes");
    refused(&["--table", page.to_str().expect("UTF-8")], 3, "page.md");
    fs::create_dir_all(&out).expect("a folder");
    fs::write(out.join("runs.jsonl"), "not a run\n").expect("writes");
    refused(&[], 3, "runs.jsonl");
    let alone = tcgs(line!["eval", "--iterations", "5", "file.tcgs", "dataset"]);
    assert_eq!(alone.status.code(), Some(2), "a flag of suites alone says nothing of a file");
    assert!(succeeds(["eval", "--help"]).contains("--suite"));
}
