//! Scripts that set machines up, run with stand-ins for the programs that would change this one.

use std::{
    env, fs,
    os::unix::fs::{PermissionsExt as _, symlink},
    path::{Path, PathBuf},
    process::{Command, Output},
};

use super::examples::there_is;

/// Programs that are what they are everywhere.
const REAL: [&str; 15] = [
    "bash", "env", "sed", "grep", "cut", "sort", "head", "dirname", "mktemp", "mkdir", "chmod", "ls", "cmp",
    "cp", "rm",
];

/// Stand-ins that do nothing.
const IDLE: [&str; 8] = ["cc", "make", "curl", "openssl", "tee", "touch", "ffmpeg", "sudo"];

/// An apt that knows every package but Chromium, and refuses a list with an unknown one.
const APT: &str = r#"case " $* " in *" install "*" chromium "*) exit 100 ;; esac
echo "$*" >>"$APT_LOG""#;
const APT_CACHE: &str =
    r#"case "$2" in chromium) echo '  Candidate: (none)' ;; *) echo '  Candidate: 1' ;; esac"#;

/// A Python that makes environments without anything in them.
const PYTHON: &str = r#"[ "$1" != -m ] || [ "$2" != venv ] || {
    mkdir -p "$3/bin"
    : >"$3/pyvenv.cfg"
    for program in pip python3; do
        printf '#!/bin/sh\n' >"$3/bin/$program"
        chmod +x "$3/bin/$program"
    done
}"#;

/// A machine that has no programs but these.
struct Machine(tempfile::TempDir);

impl Machine {
    fn new() -> Self {
        let machine = Self(tempfile::tempdir().expect("a folder"));
        fs::create_dir(machine.path("bin")).expect("a folder");
        for name in REAL {
            let places = env::var_os("PATH").unwrap_or_default();
            let program = env::split_paths(&places).map(|place| place.join(name)).find(|path| path.exists());
            symlink(program.expect(name), machine.path("bin").join(name)).expect("a link");
        }
        for (name, script) in IDLE.map(|name| (name, "")).into_iter().chain([
            ("id", "echo 0"),
            ("apt-get", APT),
            ("apt-cache", APT_CACHE),
            ("python3", PYTHON),
        ]) {
            let path = machine.path("bin").join(name);
            fs::write(&path, format!("#!/bin/sh\n{script}\n")).expect("a program");
            fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("a program");
        }
        machine
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn run(&self, script: &str, argument: &str, variables: &[(&str, &Path)]) -> Output {
        let mut command = Command::new("bash");
        command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts").join(script)).arg(argument);
        command.env_clear().env("PATH", self.path("bin")).env("HOME", self.path("home"));
        command.env("APT_LOG", self.path("apt.log")).envs(variables.iter().copied());
        command.output().expect("starts")
    }
}

#[test]
fn a_program_for_tests_that_cannot_be_had_keeps_none_of_the_others_away() {
    if !there_is("bash", &["--version"]) {
        return;
    }
    let machine = Machine::new();
    let output = machine.run("setup.sh", "--for-tests", &[]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && said.contains("no package chromium"), "{said}");
    let installed = fs::read_to_string(machine.path("apt.log")).expect("apt ran");
    let with_npm = installed.lines().find(|line| line.contains("install") && line.contains(" npm"));
    assert!(with_npm.is_some_and(|line| !line.contains("chromium")), "{installed}\n{said}");
}

#[test]
fn the_environment_for_cameras_is_made_where_a_variable_says() {
    if !there_is("bash", &["--version"]) {
        return;
    }
    let machine = Machine::new();
    let folder = machine.path("opt/poses");
    let output = machine.run("poses.sh", "--where", &[("TCGS_POSES_FOLDER", &folder)]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let interpreter = format!("{}\n", folder.join("bin/python3").display());
    assert_eq!(String::from_utf8_lossy(&output.stdout), interpreter);
    assert!(folder.join("requirements.txt").exists() && !machine.path("home").exists(), "{said}");

    // Nothing but such an environment is replaced.
    let other = machine.path("other");
    fs::create_dir(&other).expect("a folder");
    fs::write(other.join("letters.txt"), "mine").expect("a file");
    let output = machine.run("poses.sh", "--where", &[("TCGS_POSES_FOLDER", &other)]);
    assert!(!output.status.success() && other.join("letters.txt").exists());
}
