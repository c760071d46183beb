//! The figures of the documents show the tables of docs/RESULTS.md, docs/LONG_RUNS.md and docs/PLANES.md.

use std::process::Command;

use crate::support::{skip::skip, tree::root};

#[test]
fn the_figure_is_what_the_tables_give() {
    let script = root().join("scripts/plots.py");
    let Ok(output) = Command::new("python3").arg(script).arg("--check").output() else {
        return skip("python3 is not installed");
    };
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
