//! Identifiers, comments and documents have US spelling.

use std::process::Command;

use crate::support::{skip::skip_in_ci_too, tree::root};

#[test]
fn identifiers_and_documents_have_us_spelling() {
    let output = Command::new("python3").arg("scripts/us_spelling.py").current_dir(root()).output();
    let output = output.expect("python3 runs");
    let said = [output.stdout, output.stderr].concat();
    let said = String::from_utf8_lossy(&said);
    if output.status.code() == Some(2) {
        return skip_in_ci_too(&said);
    }
    assert!(output.status.success(), "{said}");
}
