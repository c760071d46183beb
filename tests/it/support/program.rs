//! The real program, run as a script would run it, on the adapter that tests use.

use std::{
    ffi::OsStr,
    process::{Command, Output},
};

use serde_json::Value;

use super::gpu;

/// The program with nothing of this process's settings but the adapter.
pub fn command() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tcgs"));
    let settings = [
        "RUST_LOG",
        "TCGS_LOG_FORMAT",
        "TCGS_LISTEN",
        "TCGS_LPIPS",
        "TCGS_DATA",
        "TCGS_DATABASE",
        "TCGS_BLOBS",
        "TCGS_MIN_FREE_SPACE",
        "TCGS_WORKER_ID",
        "TCGS_HOST_MEMORY",
        "TCGS_GPU_MEMORY",
        "TCGS_VIEW_MEMORY",
        "TCGS_WITHOUT_KEYS",
        "TCGS_REQUESTS_PER_MINUTE",
        "TCGS_QUOTA_BYTES",
        "TCGS_MAX_ACTIVE_JOBS",
        "TCGS_MAX_PRIORITY",
        "TCGS_SERVER",
        "TCGS_API_KEY",
    ];
    for name in settings {
        command.env_remove(name);
    }
    command.env("TCGS_ADAPTER", gpu::choice().to_string());
    command
}

/// Runs a command to its end.
pub fn tcgs<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> Output {
    command().args(arguments).output().expect("the binary runs")
}

/// Standard output of a command that must succeed.
#[track_caller]
pub fn succeeds<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> String {
    let output = tcgs(arguments);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Standard output, as JSON, of a command that must succeed.
#[track_caller]
pub fn answers<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> Value {
    serde_json::from_str(&succeeds(arguments)).expect("one JSON document")
}
