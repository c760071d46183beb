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
