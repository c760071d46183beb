//! Holds the layer table: which module may use which, and which external crates stay where.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

/// Each module with the modules that it may use.
const LAYERS: &[(&str, &[&str])] = &[
    ("domain", &[]),
    ("ingest", &["domain"]),
    ("gpu", &["domain"]),
    ("codec", &["domain"]),
    ("store", &["domain"]),
    ("sample", &["domain"]),
    ("export", &["domain"]),
    ("model", &["domain", "gpu"]),
    ("render", &["domain", "gpu", "model"]),
    ("eval", &["domain", "gpu", "model", "render"]),
    ("train", &["domain", "gpu", "codec", "model", "render", "eval"]),
    ("worker", &["domain", "ingest", "gpu", "codec", "export", "store", "model", "render", "eval", "train"]),
    ("https", &[]),
    ("webhooks", &["domain", "store", "https"]),
    ("http", &["domain", "codec", "store", "render"]),
];

/// External crates that only the named modules may use.
const EXTERNAL: &[(&str, &[&str])] = &[
    ("axum", &["http"]),
    ("hyper", &["http"]),
    ("hyper_util", &["http"]),
    ("tower", &["http"]),
    ("tower_http", &["http"]),
    ("prometheus_client", &["http"]),
    ("hmac", &["webhooks"]),
    ("reqwest", &["https", "webhooks", "cli"]),
    ("rustls", &["https"]),
    ("governor", &["http"]),
    ("ipnet", &["http"]),
    ("secrecy", &["domain"]),
    ("subtle", &["domain"]),
    ("getrandom", &["domain"]),
    ("sqlx", &["store"]),
    ("object_store", &["store"]),
    ("wgpu", &["gpu", "model", "render", "train"]),
    ("naga_oil", &["gpu"]),
    ("zip", &["ingest", "sample"]),
    ("constriction", &["codec"]),
    ("kiddo", &["model", "codec"]),
    ("ndarray", &["eval"]),
    ("flate2", &["export"]),
    ("zstd", &["export"]),
    ("toml", &["cli"]),
    ("fs4", &["store"]),
    ("clap", &["cli", "main"]),
    ("indicatif", &["cli"]),
];

/// `tokio` is for the layers that wait on the network, files or processes.
const TOKIO: &[&str] = &["store", "worker", "webhooks", "http", "cli", "main"];

fn sources(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("src is readable") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            sources(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push(path);
        }
    }
}

fn module_of(path: &Path, root: &Path) -> String {
    let relative = path.strip_prefix(root).expect("under src");
    let first = relative.components().next().expect("a component").as_os_str().to_string_lossy().into_owned();
    first.trim_end_matches(".rs").to_owned()
}

/// The identifiers that follow `prefix::` in `text`, with `prefix::{a, b}` opened up.
fn roots_after(text: &str, prefix: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (start, _) in text.match_indices(prefix) {
        let before = text[..start].chars().next_back();
        if before.is_some_and(|c| c.is_alphanumeric() || c == '_' || c == ':') {
            continue;
        }
        let rest = &text[start + prefix.len()..];
        let names: Vec<&str> =
            if let Some(group) = rest.strip_prefix('{') { top_level_items(group) } else { vec![rest] };
        for name in names {
            let name: String = name.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
            if !name.is_empty() {
                found.insert(name);
            }
        }
    }
    found
}

/// The items of a braced list up to its closing brace, with what nested braces hold left inside their item.
fn top_level_items(group: &str) -> Vec<&str> {
    let (mut items, mut depth, mut start) = (Vec::new(), 0, 0);
    for (at, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth > 0 => depth -= 1,
            ',' if depth > 0 => {}
            ',' | '}' => {
                items.push(&group[start..at]);
                start = at + 1;
                if c == '}' {
                    break;
                }
            }
            _ => {}
        }
    }
    items
}

#[test]
fn layers_point_one_way() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    sources(&root, &mut files);
    let mut faults = Vec::new();
    for path in &files {
        let module = module_of(path, &root);
        let text = fs::read_to_string(path).expect("readable source");
        let code: String =
            text.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n");
        let is_top = matches!(module.as_str(), "main" | "lib" | "cli");
        if !is_top {
            let Some((_, allowed)) = LAYERS.iter().find(|(name, _)| *name == module) else {
                faults.push(format!("{}: module '{module}' is not in the table", path.display()));
                continue;
            };
            for used in roots_after(&code, "crate::") {
                if used != module && !allowed.contains(&used.as_str()) {
                    faults.push(format!("{}: {module} must not use {used}", path.display()));
                }
            }
        }
        for (external, allowed) in EXTERNAL {
            if code.contains(&format!("{external}::")) && !allowed.contains(&module.as_str()) {
                let really = code.match_indices(&format!("{external}::")).any(|(start, _)| {
                    !code[..start]
                        .chars()
                        .next_back()
                        .is_some_and(|c| c.is_alphanumeric() || c == '_' || c == ':')
                });
                if really {
                    faults.push(format!("{}: {module} must not use the crate {external}", path.display()));
                }
            }
        }
        if roots_after(&code, "tokio::").iter().next().is_some() && !TOKIO.contains(&module.as_str()) {
            faults.push(format!("{}: {module} must not use tokio", path.display()));
        }
    }
    assert!(faults.is_empty(), "the layer table is broken:\n{}", faults.join("\n"));
}

#[test]
fn the_layer_test_sees_grouped_and_plain_uses() {
    let text =
        "use crate::{domain::{Camera, Pose}, gpu};\nlet x = crate::store::open();\nuse my_crate::other;";
    let expected: BTreeSet<String> = ["domain", "gpu", "store"].map(str::to_owned).into();
    assert_eq!(roots_after(text, "crate::"), expected);
}

/// The fuzz targets compile the codec and the domain by themselves, and nothing else builds them.
#[test]
fn what_is_fuzzed_has_the_crates_that_its_sources_use() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    // A crate a line: the manifests are written so.
    let crates = |manifest: &str| -> BTreeMap<String, String> {
        let text = fs::read_to_string(root.join(manifest)).expect("a manifest");
        let lines = text.lines().skip_while(|line| *line != "[dependencies]").skip(1);
        let lines = lines.take_while(|line| !line.starts_with('['));
        lines.filter_map(|line| line.split_once(" = ")).map(|(a, b)| (a.to_owned(), b.to_owned())).collect()
    };
    let (project, fuzzed) = (crates("Cargo.toml"), crates("fuzz/Cargo.toml"));
    let (mut files, mut found) = (Vec::new(), 0);
    for module in ["codec", "domain"] {
        sources(&root.join("src").join(module), &mut files);
    }
    let texts: Vec<String> =
        files.iter().map(|file| fs::read_to_string(file).expect("a source file")).collect();
    for (name, wanted) in &project {
        let place = name.replace('-', "_");
        let is_module = files.iter().any(|file| file.file_stem().is_some_and(|stem| stem == place.as_str()));
        let path = format!("{place}::");
        let is_used = texts.iter().any(|text| {
            text.match_indices(&path).any(|(at, _)| {
                !text[..at]
                    .ends_with(|before: char| before.is_alphanumeric() || before == '_' || before == ':')
            })
        });
        if is_used && !is_module {
            found += 1;
            assert_eq!(fuzzed.get(name), Some(wanted), "{name} in fuzz/Cargo.toml");
        }
    }
    assert!(found > 10, "{found}");
}
