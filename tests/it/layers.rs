//! Holds the layer tables of the service and the engine: which module may use which, and which external crates stay where. Cargo holds
//! which crate uses which. Within every crate, files of a folder form no circles.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use proc_macro2::{TokenStream, TokenTree};

/// The modules of a crate, each with those that it may use.
type Layers = &'static [(&'static str, &'static [&'static str])];

/// Each module of the service and of the engine with the modules that it may use; those of other crates by the names that the crate
/// gives them.
const LAYERS: &[(&str, Layers)] = &[
    (
        "tcgs",
        &[
            ("domain", &[]),
            ("store", &["domain"]),
            ("engine", &["domain", "ingest", "export", "pipeline", "render"]),
            ("worker", &["domain", "store", "ingest", "poses", "pipeline"]),
            ("https", &[]),
            ("webhooks", &["domain", "store", "https"]),
            ("viewers", &["domain", "ingest", "engine", "store", "render", "https"]),
            ("viewer_page", &["domain"]),
            (
                "http",
                &[
                    "domain",
                    "codec",
                    "engine",
                    "store",
                    "render",
                    "viewers",
                    "plot",
                    "picture",
                    "viewer_page",
                ],
            ),
        ],
    ),
    (
        "tcgs_engine",
        &[
            ("domain", &[]),
            ("ply", &[]),
            ("picture", &["domain"]),
            ("plot", &[]),
            ("poses", &["domain", "ingest"]),
            ("sample", &["domain"]),
            ("ingest", &["domain", "ply"]),
            ("export", &["domain", "ply"]),
            ("init", &["domain", "model"]),
            ("eval", &["domain", "gpu", "model", "render"]),
            ("train", &["domain", "gpu", "codec", "model", "init", "render", "eval"]),
            (
                "pipeline",
                &[
                    "domain", "ingest", "gpu", "codec", "export", "model", "render", "eval", "train",
                    "picture",
                ],
            ),
        ],
    ),
];

/// External crates that only the named modules of a crate may use.
const EXTERNAL: &[(&str, &[&str])] = &[
    ("axum", &["http"]),
    ("http_body", &["store"]),
    ("hyper", &["http"]),
    ("hyper_util", &["http"]),
    ("tower", &["http"]),
    ("tower_http", &["http"]),
    ("prometheus_client", &["http"]),
    ("hmac", &["domain", "webhooks"]),
    ("reqwest", &["https", "viewers", "webhooks", "cli"]),
    ("postcard", &["viewers"]),
    ("rustls", &["store", "https"]),
    ("governor", &["http"]),
    ("ipnet", &["http"]),
    ("secrecy", &["domain"]),
    ("subtle", &["domain"]),
    ("getrandom", &["domain"]),
    ("sqlx", &["store"]),
    ("object_store", &["store"]),
    ("wgpu", &["gpu"]),
    ("naga_oil", &["gpu"]),
    ("webp", &["picture"]),
    ("zip", &["export", "ingest", "sample"]),
    ("unicode_normalization", &["ingest"]),
    ("kiddo", &["init"]),
    ("jpeg_encoder", &["picture", "sample"]),
    ("crc32fast", &["picture"]),
    ("ndarray", &["lpips"]),
    ("flate2", &["export", "viewer_page"]),
    ("zstd", &["export"]),
    ("toml", &["cli", "report"]),
    ("fs4", &["store"]),
    ("clap", &["cli", "main"]),
    ("indicatif", &["cli"]),
];

/// `tokio` is for the layers that wait on the network, files or processes.
const TOKIO: &[&str] = &["store", "viewers", "worker", "webhooks", "http", "cli", "main"];

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

/// The sources of each crate by its name.
fn crates() -> Vec<(&'static str, PathBuf)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let member = |name: &'static str| (name, root.join("crates").join(name.replace('_', "-")).join("src"));
    vec![
        ("tcgs", root.join("src")),
        member("tcgs_codec"),
        member("tcgs_render"),
        member("tcgs_engine"),
        member("tcgs_lab"),
        member("tcgs_web"),
    ]
}

#[test]
fn every_crate_is_looked_at() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates");
    let members = fs::read_dir(folder).expect("crates").count();
    assert_eq!(crates().len(), 1 + members);
}

/// The crate, and the modules from its root down to what a file holds.
fn place_of(path: &Path, name: &str, root: &Path) -> Vec<String> {
    let relative = path.strip_prefix(root).expect("under src").with_extension("");
    let names = relative.components().map(|part| part.as_os_str().to_string_lossy().into_owned());
    let mut place: Vec<String> = std::iter::once(name.to_owned()).chain(names).collect();
    if place.last().is_some_and(|last| matches!(last.as_str(), "mod" | "lib" | "main")) {
        place.pop();
    }
    place
}

/// What the paths of a file begin with, in `use` trees, expressions, types and the arguments of macros alike.
#[derive(Debug, Default)]
struct Uses {
    /// Modules of this crate's root, however they are reached; `*` where the root itself is named.
    modules: BTreeSet<String>,
    /// First names of all other paths: external crates, and whatever is in scope.
    others: BTreeSet<String>,
    /// Every path of the crate from its root, but those of tests; others are taken for paths from the file's own module.
    paths: BTreeSet<Vec<String>>,
    /// What names in scope stand for.
    imports: BTreeMap<String, Vec<String>>,
}

impl Uses {
    fn of(source: &str, place: &[String]) -> Self {
        let mut uses = Self::default();
        let tokens: TokenStream = source.parse().expect("Rust");
        uses.walk(tokens, &mut place.to_vec());
        uses
    }

    fn walk(&mut self, tokens: TokenStream, place: &mut Vec<String>) {
        let tokens: Vec<TokenTree> = tokens.into_iter().collect();
        let mut at = 0;
        while at < tokens.len() {
            if let [TokenTree::Ident(word), TokenTree::Ident(name), TokenTree::Group(body), ..] =
                &tokens[at..]
                && word == "mod"
            {
                place.push(name.to_string());
                self.walk(body.stream(), place);
                place.pop();
                at += 3;
                continue;
            }
            match &tokens[at] {
                TokenTree::Group(group) => self.walk(group.stream(), place),
                TokenTree::Ident(word) if word == "use" => {
                    let end =
                        tokens[at..].iter().position(|token| is(token, ';')).map_or(tokens.len(), |n| at + n);
                    self.tree(&tokens[at + 1..end], &mut Vec::new(), place);
                    at = end;
                }
                TokenTree::Ident(_) if starts_a_path(&tokens, at) => at = self.path(&tokens, at, place),
                _ => {}
            }
            at += 1;
        }
    }

    /// A path outside of a `use`; returns the place of its last token.
    fn path(&mut self, tokens: &[TokenTree], mut at: usize, place: &[String]) -> usize {
        let mut names = vec![tokens[at].to_string()];
        while separates(tokens, at + 1)
            && let Some(TokenTree::Ident(name)) = tokens.get(at + 3)
        {
            names.push(name.to_string());
            at += 3;
        }
        if names.len() > 1 {
            self.add(&names, place);
        }
        at
    }

    /// A tree of a `use`, with the names that lead to it.
    fn tree(&mut self, tokens: &[TokenTree], prefix: &mut Vec<String>, place: &[String]) {
        let length = prefix.len();
        let mut at = if separates(tokens, 0) { 2 } else { 0 };
        loop {
            match tokens.get(at) {
                Some(TokenTree::Ident(name)) => prefix.push(name.to_string()),
                Some(TokenTree::Group(group)) => {
                    let items: Vec<TokenTree> = group.stream().into_iter().collect();
                    items.split(|token| is(token, ',')).for_each(|item| self.tree(item, prefix, place));
                    break;
                }
                _ => {
                    if at < tokens.len() {
                        self.import(prefix, place);
                    }
                    break;
                }
            }
            if !separates(tokens, at + 1) {
                self.import(prefix, place);
                break;
            }
            at += 3;
        }
        prefix.truncate(length);
    }

    /// A path; returns it with the crate's name, where a name that is not of this crate is taken for one of this module.
    fn add(&mut self, names: &[String], place: &[String]) -> Vec<String> {
        let mut depth = place.len();
        let mut rest = names;
        let mut is_relative = false;
        while let [first, more @ ..] = rest {
            match first.as_str() {
                "crate" => depth = 1,
                "super" => depth = depth.saturating_sub(1).max(1),
                "self" => {}
                _ => break,
            }
            (rest, is_relative) = (more, true);
        }
        if !is_relative {
            self.others.extend(names.first().cloned());
        } else if depth == 1 {
            self.modules.insert(rest.first().map_or("*", String::as_str).to_owned());
        }
        let path: Vec<String> =
            place[..depth].iter().chain(rest).filter(|name| *name != "self").cloned().collect();
        if !place.iter().any(|name| name == "tests") {
            self.paths.insert(path.clone());
        }
        path
    }

    /// A path that a `use` brings into scope.
    fn import(&mut self, names: &[String], place: &[String]) {
        let path = self.add(names, place);
        if let Some(name) = path.last() {
            self.imports.insert(name.clone(), path.clone());
        }
    }
}

fn is(token: &TokenTree, letter: char) -> bool {
    matches!(token, TokenTree::Punct(punct) if punct.as_char() == letter)
}

/// Whether `::` is at that place.
fn separates(tokens: &[TokenTree], at: usize) -> bool {
    [at, at + 1].iter().all(|at| tokens.get(*at).is_some_and(|token| is(token, ':')))
}

/// Whether the name there is the first of a path: not behind `a::` or `a.`, but perhaps behind a leading `::`.
fn starts_a_path(tokens: &[TokenTree], at: usize) -> bool {
    let before = |by: usize| at.checked_sub(by).map(|at| &tokens[at]);
    match before(1) {
        Some(token) if is(token, '.') => false,
        Some(token) if is(token, ':') && before(2).is_some_and(|token| is(token, ':')) => {
            !matches!(before(3), Some(TokenTree::Ident(_) | TokenTree::Group(_)))
                && !before(3).is_some_and(|token| is(token, '>'))
        }
        _ => true,
    }
}

/// The layers of a crate; none of one whose root is not divided.
fn layers_of(name: &str) -> Option<Layers> {
    LAYERS.iter().find(|(of, _)| *of == name).map(|(_, layers)| *layers)
}

#[test]
fn layers_point_one_way() {
    let mut faults = Vec::new();
    for (name, root) in crates() {
        let layers = layers_of(name);
        let mut files = Vec::new();
        sources(&root, &mut files);
        for path in &files {
            let module = module_of(path, &root);
            let text = fs::read_to_string(path).expect("readable source");
            let uses = Uses::of(&text, &place_of(path, name, &root));
            for (external, allowed) in EXTERNAL.iter().chain([&("tokio", TOKIO)]) {
                if uses.others.contains(*external) && !allowed.contains(&module.as_str()) {
                    faults.push(format!("{}: {module} must not use the crate {external}", path.display()));
                }
            }
            let Some(layers) = layers else { continue };
            if matches!(module.as_str(), "main" | "lib" | "cli") {
                continue;
            }
            let Some((_, allowed)) = layers.iter().find(|(layer, _)| *layer == module) else {
                faults.push(format!("{}: module '{module}' is not in the table", path.display()));
                continue;
            };
            for used in &uses.modules {
                if *used != module && !allowed.contains(&used.as_str()) {
                    faults.push(format!("{}: {module} must not use {used}", path.display()));
                }
            }
        }
    }
    assert!(faults.is_empty(), "the layer table is broken:\n{}", faults.join("\n"));
}

#[test]
fn every_form_of_a_path_is_seen() {
    let text = r#"
        use crate::{domain::{Camera, Pose}, gpu as device};
        use super::super::store::{self, Blobs};
        use ::axum::{Router, routing::get};
        use super::{sibling, super::super::eval};
        mod inner { use super::super::super::render::views; use super::super::own; }
        fn f(x: crate::codec::File) -> Vec<hyper::Body> {
            tracing::info!(a = ?crate::train::train(), "crate::worker::run");
            x.reqwest::<u8>(); // crate::webhooks
            <crate::model::Rows as Default>::default()
        }
    "#;
    let uses = Uses::of(text, &["tcgs", "http", "views"].map(str::to_owned));
    let modules = ["codec", "domain", "eval", "gpu", "model", "render", "store", "train"];
    // `eval` is one `super` too far, which does not compile; the root is as far as it goes.
    assert_eq!(uses.modules, modules.map(str::to_owned).into());
    for other in ["axum", "hyper", "tracing"] {
        assert!(uses.others.contains(other), "{other}: {:?}", uses.others);
    }
    assert!(!uses.others.contains("reqwest") && !uses.others.contains("my_crate"));
    let whole = Uses::of("use crate::*;", &["tcgs", "http"].map(str::to_owned));
    assert_eq!(whole.modules, ["*".to_owned()].into());
}

/// The modules of all crates, with the paths that each uses.
struct Modules(BTreeMap<Vec<String>, Uses>);

impl Modules {
    fn read() -> Self {
        let mut modules = BTreeMap::new();
        for (name, root) in crates() {
            let mut files = Vec::new();
            sources(&root, &mut files);
            modules.extend(files.iter().map(|path| {
                let place = place_of(path, name, &root);
                let uses = Uses::of(&fs::read_to_string(path).expect("readable source"), &place);
                (place, uses)
            }));
        }
        Self(modules)
    }

    /// The module where a path's item is declared: the path is followed through what modules on its way import.
    fn home(&self, path: &[String], steps: usize) -> Vec<String> {
        let mut at = 0;
        while at < path.len() && self.0.contains_key(&path[..=at]) {
            at += 1;
        }
        let (module, rest) = path.split_at(at);
        let imported = rest.first().and_then(|name| self.0.get(module)?.imports.get(name));
        match imported {
            Some(target) if steps > 0 && target != path => {
                let target: Vec<String> = target.iter().chain(&rest[1..]).cloned().collect();
                self.home(&target, steps - 1)
            }
            _ => module.to_vec(),
        }
    }

    /// Which of the files and folders directly in `folder` use which others.
    fn siblings(&self, folder: &[String]) -> BTreeMap<String, BTreeSet<String>> {
        let child = |module: &[String]| module.strip_prefix(folder)?.first().cloned();
        let mut used: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        for (module, uses) in &self.0 {
            let Some(from) = child(module) else { continue };
            let homes = uses.paths.iter().map(|path| self.home(path, 8));
            let others = homes.filter_map(|home| child(&home)).filter(|to| *to != from);
            used.entry(from.clone()).or_default().extend(others);
        }
        used
    }
}

/// Files and folders directly in one folder form layers too: none uses another that uses it, directly or through others.
#[test]
fn no_circle_of_imports_in_a_folder() {
    let modules = Modules::read();
    let folders: BTreeSet<&[String]> =
        modules.0.keys().flat_map(|module| (1..module.len()).map(move |end| &module[..end])).collect();
    let mut circles = Vec::new();
    for folder in folders {
        let mut used = modules.siblings(folder);
        // What uses nothing of the rest is in no circle.
        while let Some(end) = used.iter().find(|(_, others)| others.is_empty()).map(|(name, _)| name.clone())
        {
            used.remove(&end);
            used.values_mut().for_each(|others| _ = others.remove(&end));
        }
        if !used.is_empty() {
            circles.push(format!("{}: {used:?}", folder.join("/")));
        }
    }
    assert!(circles.is_empty(), "imports form circles, or lead to some:\n{}", circles.join("\n"));
}

/// Rows of ARCHITECTURE.md's table: each module with those that it may use.
fn documented() -> BTreeMap<String, BTreeSet<String>> {
    let document = Path::new(env!("CARGO_MANIFEST_DIR")).join("ARCHITECTURE.md");
    let text = fs::read_to_string(document).expect("a document");
    let rows = text.lines().skip_while(|line| !line.starts_with("| layer |")).skip(2);
    let names =
        |cell: &str| -> BTreeSet<String> { cell.split('`').skip(1).step_by(2).map(str::to_owned).collect() };
    let rows = rows.take_while(|line| line.starts_with('|')).flat_map(|line| {
        let mut cells = line.trim_matches('|').split('|');
        let (layers, used) = (cells.next().expect("layers"), cells.next().expect("what they may use"));
        let used = names(used);
        names(layers).into_iter().map(move |layer| (layer, used.clone()))
    });
    rows.collect()
}

#[test]
fn the_documented_layers_are_those_that_are_held() {
    let mut documented = documented();
    assert_eq!(documented.remove("cli"), Some(BTreeSet::new()), "the row of `cli` says 'everything'");
    let held = LAYERS.iter().flat_map(|(_, layers)| *layers).map(|(layer, used)| {
        ((*layer).to_owned(), used.iter().map(|name| (*name).to_owned()).collect::<BTreeSet<_>>())
    });
    assert_eq!(documented, held.collect());
}
