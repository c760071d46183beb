//! `tcgs bench accuracy`: every case on the shared device, the command's document, and the page that lists the cases.

use std::{collections::BTreeSet, sync::Arc};

use serde_json::Value;
use tcgs::gpu::Device;
use tcgs_lab::accuracy::{self, Bound, Case};

use crate::support::{
    gpu::{gpu, variants},
    program,
    tree::text,
};

/// A row of the page's table; `error` is left out of what is compared.
fn row(case: &Case, bound: &Bound, error: &str) -> String {
    format!("| `{}` | {} | {error} | {:.0e} | {} |", case.name, bound.quantity, bound.largest, bound.why)
}

/// Prints the page's table.
fn assert_within_the_bounds(device: &Arc<Device>) {
    let mut exceeded = Vec::new();
    for case in accuracy::cases() {
        let outcomes = case.outcomes(device).unwrap_or_else(|error| panic!("{error}"));
        for (outcome, bound) in outcomes.iter().zip(case.bounds) {
            let line = row(case, bound, &format!("{:.1e}", outcome.error));
            println!("{line}");
            if !outcome.held {
                exceeded.push(line);
            }
        }
    }
    assert!(exceeded.is_empty(), "beyond their bounds:\n{}", exceeded.join("\n"));
}

#[test]
fn every_error_is_within_its_bound() {
    assert_within_the_bounds(&gpu());
}

#[test]
fn the_kernels_for_hardware_are_within_the_bounds_too() {
    let [_, hardware] = variants();
    assert_within_the_bounds(&hardware);
}

#[test]
fn the_command_prints_one_document_of_adapter_and_cases() {
    let document = program::answers(["bench", "accuracy", "--json"]);
    let names =
        |value: &Value| -> Vec<String> { value.as_object().expect("an object").keys().cloned().collect() };
    assert_eq!(names(&document), ["adapter", "cases"]);
    assert_eq!(document["adapter"], Value::String(gpu().adapter_line()));
    let cases = document["cases"].as_array().expect("cases");
    let expected: usize = accuracy::cases().iter().map(|case| case.bounds.len()).sum();
    assert_eq!(cases.len(), expected);
    for case in cases {
        assert_eq!(names(case), ["name", "quantity", "error", "bound", "held"]);
        assert!(case["name"].is_string() && case["quantity"].is_string(), "{case}");
        assert!(case["error"].as_f64() <= case["bound"].as_f64() && case["held"] == true, "{case}");
    }
}

#[test]
fn the_page_lists_every_case_with_its_bounds_and_their_reasons() {
    let page = text("docs/ACCURACY.md");
    let without_error = |row: &str| {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        [&cells[..3], &cells[4..]].concat().join("|")
    };
    let rows = page.lines().filter(|line| line.starts_with("| `"));
    let listed: BTreeSet<String> = rows.map(without_error).collect();
    let held = accuracy::cases()
        .into_iter()
        .flat_map(|case| case.bounds.iter().map(|bound| without_error(&row(case, bound, ""))));
    assert_eq!(listed, held.collect());
}
