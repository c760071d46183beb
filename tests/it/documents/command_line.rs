//! The page on the command line names flags that there are.

use std::collections::BTreeSet;

use crate::support::{program, tree::text};

const PAGES: [&str; 3] = ["README.md", "docs/CLI.md", "docs/PRESETS.md"];

fn help(arguments: &[&str]) -> String {
    let output = program::command().args(arguments).arg("--help").output().expect("the binary runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// The flags in a text: `--` and a letter, then lower-case letters and hyphens.
fn flags(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !c.is_ascii_lowercase() && c != '-');
    let named = words
        .filter(|word| word.strip_prefix("--").is_some_and(|rest| rest.starts_with(char::is_alphabetic)));
    named.map(str::to_owned).collect()
}

#[test]
fn flags_in_the_documents_exist() {
    let commands = help(&[]);
    // Groups of commands, each a line that is set in.
    let (groups, _) = commands.split_once("\nOptions:").expect("options after the commands");
    let commands = groups.lines().filter_map(|line| line.strip_prefix("  "));
    let mut known = flags(&help(&["keys", "create"]));
    for bench in ["contexts", "report", "views"] {
        known.extend(flags(&help(&["bench", bench])));
    }
    for command in commands.filter_map(|line| line.split(' ').next()) {
        known.extend(flags(&help(&[command])));
    }
    assert!(known.contains("--iterations") && known.contains("--rd-curve"), "{known:?}");
    // Flags of other programs that the pages call.
    let others = ["--build", "--data-binary", "--example", "--release"].map(str::to_owned);
    for page in PAGES {
        let unknown: Vec<String> = flags(&text(page))
            .into_iter()
            .filter(|flag| !known.contains(flag) && !others.contains(flag))
            .collect();
        assert!(unknown.is_empty(), "{page}: {unknown:?}");
    }
}
