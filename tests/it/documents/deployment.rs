//! What operators copy names what the program has: the table of settings, the systemd unit, the compose file and the image.

use std::{collections::BTreeMap, fs, process::Command, time::Duration};

use crate::support::{program, skip::skip, tree::text};

const UNIT: &str = "docker/tcgs.service";

/// Standard output of `tcgs serve` with the one argument, and nothing of this process's settings.
fn serve(argument: &str) -> String {
    let mut command = program::command();
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("TCGS_")) {
        command.env_remove(name);
    }
    let output =
        command.env_remove("TCGS_ADAPTER").args(["serve", argument]).output().expect("the binary runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Every setting of `serve` as a flag, with its default.
fn settings() -> BTreeMap<String, String> {
    let printed = serve("--print-config");
    let lines = printed.lines().skip(1).map(|line| {
        let (name, value) = match line.strip_prefix("# ") {
            Some(unset) => (unset.strip_suffix(" is not set").expect("an absent setting"), "-"),
            None => {
                line.strip_suffix("  # default").and_then(|line| line.split_once(" = ")).expect("a default")
            }
        };
        let value = if value == "false" { "-" } else { value.trim_matches('"') };
        (format!("--{}", name.replace('_', "-")), value.to_owned())
    });
    lines.collect()
}

/// Holds a variable to the help of `tcgs serve`, which tells those that it reads.
fn assert_is_a_variable_of_serve(name: &str, help: &str, place: &str) {
    assert!(help.contains(&format!("[env: {name}=")), "{place}: `tcgs serve` does not read {name}");
}

/// A unit's assignments in their order, by section and key.
fn unit() -> Vec<(String, String, String)> {
    let (mut section, mut found) = (String::new(), Vec::new());
    for line in text(UNIT).lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        if let Some(name) = line.strip_prefix('[') {
            section = name.strip_suffix(']').expect("the end of a section's name").to_owned();
        } else {
            let (key, value) = line.split_once('=').unwrap_or_else(|| panic!("{UNIT}: {line}"));
            found.push((section.clone(), key.to_owned(), value.to_owned()));
        }
    }
    found
}

/// The time between a stop and the kill has to be enough for requests and then for workers.
fn assert_leaves_time_to_stop(seconds: &str, place: &str) {
    let seconds = seconds.trim_end_matches('s').parse().expect("seconds");
    let (http, worker) = (tcgs::http::HttpConfig::default(), tcgs::worker::WorkerConfig::from_environment());
    let needed = http.drain_notice + http.drain + worker.drain;
    assert!(Duration::from_secs(seconds) > needed, "{place}: {seconds} s are too short for {needed:?}");
}

#[test]
fn the_table_of_settings_has_every_flag_of_serve_with_its_default() {
    let document = text("docs/OPERATIONS.md");
    let rows = document.lines().filter_map(|line| line.strip_prefix("| `--"));
    let rows: Vec<(String, String)> = rows
        .map(|row| {
            let mut cells = row.split('|').map(str::trim);
            let flag = cells.next().and_then(|cell| cell.strip_suffix('`')).expect("a flag");
            (format!("--{flag}"), cells.next().expect("a default").to_owned())
        })
        .collect();
    let documented: BTreeMap<String, String> = rows.iter().cloned().collect();
    assert_eq!(documented.len(), rows.len(), "a flag has two rows");
    assert_eq!(documented, settings());
}

#[test]
fn the_unit_starts_the_service_with_settings_that_there_are() {
    let unit = unit();
    let of = |wanted: &str| -> Vec<&str> {
        let found = unit.iter().filter(|(section, key, _)| section == "Service" && key == wanted);
        found.map(|(_, _, value)| value.as_str()).collect()
    };
    let [start] = of("ExecStart")[..] else { panic!("one program is to be started: {unit:?}") };
    let (settings, help) = (settings(), serve("--help"));
    let flags = start.strip_prefix("/usr/local/bin/tcgs serve").expect("the service").split_whitespace();
    for flag in flags.filter(|word| word.starts_with("--")) {
        assert!(settings.contains_key(flag.split('=').next().expect("a name")), "{UNIT}: {flag}");
    }
    let variables = of("Environment").into_iter().flat_map(str::split_whitespace);
    let names: Vec<&str> = variables.filter_map(|one| Some(one.split_once('=')?.0)).collect();
    assert!(names.contains(&"TCGS_DATA"), "{names:?}");
    for name in names.iter().filter(|name| name.starts_with("TCGS_")) {
        assert_is_a_variable_of_serve(name, &help, UNIT);
    }
    let [patience] = of("TimeoutStopSec")[..] else { panic!("one time to stop: {unit:?}") };
    assert_leaves_time_to_stop(patience, UNIT);
    // A driver that compiles kernels in memory dies under the first; a run reads /proc/meminfo, which the second hides.
    assert!(of("MemoryDenyWriteExecute").is_empty() && of("ProcSubset").is_empty());
}

/// systemd says itself what it thinks of the unit.
#[test]
fn systemd_takes_the_unit_without_a_word() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("tcgs.service");
    let unit = text(UNIT).replace("/usr/local/bin/tcgs", env!("CARGO_BIN_EXE_tcgs"));
    fs::write(&path, unit).expect("written");
    let Ok(output) = Command::new("systemd-analyze").arg("verify").arg(&path).output() else {
        return skip("systemd-analyze is not installed");
    };
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && !said.contains("tcgs.service"), "{said}");
}

/// Packs a small program in the place of this one, which takes a minute to compress.
#[test]
fn the_debian_package_has_the_program_its_unit_and_what_they_need() {
    let folder = tempfile::tempdir().expect("a folder");
    let tools = ["dpkg-deb", "dpkg-shlibdeps", "strip"];
    if tools.iter().any(|tool| Command::new(tool).arg("--version").output().is_err()) {
        return skip("dpkg-dev and binutils are not installed");
    }
    let mut build = Command::new(concat!(env!("CARGO_MANIFEST_DIR"), "/scripts/build_deb.sh"));
    let output = build.arg("/bin/true").env("CARGO_TARGET_DIR", folder.path()).output().expect("a shell");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let package = String::from_utf8(output.stdout).expect("a path");
    assert!(package.contains(concat!("/tcgs_", env!("CARGO_PKG_VERSION"), "_")), "{package}");
    let of = |arguments: &[&str]| {
        let output = Command::new("dpkg-deb").args(arguments).output().expect("dpkg-deb");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).expect("UTF-8")
    };
    let needs = of(&["--field", package.trim(), "Depends"]);
    for needed in ["libc6 (>= ", "libvulkan1", "mesa-vulkan-drivers | vulkan-icd", "ca-certificates"] {
        assert!(needs.contains(needed), "{needs}");
    }
    let root = folder.path().join("root");
    of(&["--extract", package.trim(), &root.display().to_string()]);
    let unit = fs::read_to_string(root.join("usr/lib/systemd/system/tcgs.service")).expect("the unit");
    assert_eq!(unit.lines().filter(|line| *line == "ExecStart=/usr/bin/tcgs serve").count(), 1, "{unit}");
    for file in ["usr/bin/tcgs", "usr/share/doc/tcgs/copyright", "usr/share/doc/tcgs/OPERATIONS.md"] {
        assert!(root.join(file).exists(), "{file}");
    }
    let script = of(&["--info", package.trim(), "postinst"]);
    assert!(script.contains("useradd --system"), "{script}");
}

#[test]
fn the_image_and_the_compose_file_set_what_the_service_reads_and_ask_whether_it_is_ready() {
    let help = serve("--help");
    let image = text("docker/Dockerfile");
    let (_, health) = image.split_once("HEALTHCHECK").expect("a check");
    assert!(health.contains("/readyz"), "{health}");
    let words = image.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_');
    for name in words.filter(|word| word.starts_with("TCGS_")) {
        assert_is_a_variable_of_serve(name, &help, "docker/Dockerfile");
    }
    let compose: serde_json::Value =
        yaml_serde::from_str(&text("docker/compose.yaml")).expect("the compose file is YAML");
    let service = &compose["services"]["tcgs"];
    let variables = service["environment"].as_object().expect("variables");
    for name in variables.keys().filter(|name| name.starts_with("TCGS_")) {
        assert_is_a_variable_of_serve(name, &help, "docker/compose.yaml");
    }
    assert_eq!(service["build"]["dockerfile"], "docker/Dockerfile");
    assert!(service["healthcheck"].is_null(), "the image's check is what `tcgs` is asked by");
    assert_leaves_time_to_stop(service["stop_grace_period"].as_str().expect("a time"), "docker/compose.yaml");
}
