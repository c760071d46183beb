//! `tcgs doctor`: the adapters of this machine, and advice.

use std::{env, thread};

use serde::Serialize;
use tcgs::{
    domain::{Problem, ProblemType},
    gpu::{self, AdapterChoice, AdapterReport},
    poses::{NetworkIsolation, PoseProgram, ffmpeg_version},
};

use super::{CliError, Report, camera_search::usual_camera_search, notice::notice};

/// Arguments of `tcgs doctor`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Debug, Serialize)]
struct Machine {
    version: &'static str,
    system: String,
    threads: usize,
    /// Best first; `--adapter auto` takes the first that is usable.
    adapters: Vec<AdapterReport>,
    /// The program that finds cameras of photographs, if there is one.
    cameras: Option<PoseProgram>,
    /// The version of ffmpeg, if there is one.
    ffmpeg: Option<String>,
    advice: Vec<String>,
}

/// Lists the adapters; fails with status 4 if none is usable.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let adapters = gpu::report();
    let search = usual_camera_search(None);
    let mut machine = Machine {
        version: env!("CARGO_PKG_VERSION"),
        system: format!("{} {}", env::consts::OS, env::consts::ARCH),
        threads: thread::available_parallelism().map_or(1, usize::from),
        advice: advice(&adapters, env::var_os("XDG_RUNTIME_DIR").is_some()),
        adapters,
        cameras: search.estimator.probe().ok(),
        ffmpeg: ffmpeg_version(&search.estimator.ffmpeg).ok(),
    };
    machine.advice.extend(camera_advice(&machine));
    let usable = machine.adapters.iter().any(|adapter| adapter.usable);
    let chosen = usable.then(|| unmatched_choice(&machine.adapters, env::var("TCGS_ADAPTER").ok()));
    if chosen == Some(None) {
        return Ok(Report::new(text(&machine), &machine));
    }
    if !args.json {
        notice(text(&machine));
    }
    if let Some(Some(detail)) = chosen {
        return Err(Problem::new(ProblemType::NoAdapter, detail).into());
    }
    let detail = advice(&machine.adapters, env::var_os("XDG_RUNTIME_DIR").is_some()).join("; ");
    Err(Problem::new(ProblemType::NoAdapter, detail).into())
}

/// What is wrong with the variable that chooses an adapter, if it chooses none of these.
fn unmatched_choice(adapters: &[AdapterReport], variable: Option<String>) -> Option<String> {
    let wanted = variable?;
    let Ok(choice) = wanted.parse::<AdapterChoice>();
    (!adapters.iter().any(|adapter| choice.accepts_report(adapter))).then(|| {
        format!(
            "TCGS_ADAPTER is '{wanted}', which is no usable adapter of this machine; unset it or name one"
        )
    })
}

fn advice(adapters: &[AdapterReport], has_runtime_dir: bool) -> Vec<String> {
    let mut advice = Vec::new();
    if adapters.is_empty() {
        advice.push("install a Vulkan driver: on Debian, apt-get install mesa-vulkan-drivers".to_owned());
    } else if !adapters.iter().any(|adapter| adapter.usable) {
        advice.push("no adapter has the limits that are needed; a newer driver may".to_owned());
    }
    if cfg!(target_os = "linux") && !has_runtime_dir {
        advice.push(
            "set XDG_RUNTIME_DIR to a private folder: some drivers warn or slow down without it".to_owned(),
        );
    }
    for adapter in adapters.iter().filter(|adapter| adapter.usable && is_old_lavapipe(adapter)) {
        advice.push(format!(
            "'{}' runs on an old Mesa; version 24 or newer is about twice as fast (Debian 12: bookworm-backports)",
            adapter.name
        ));
    }
    advice
}

/// Whether this is Mesa's software adapter from before version 24.
fn is_old_lavapipe(adapter: &AdapterReport) -> bool {
    let version = adapter.driver.split("Mesa ").nth(1).and_then(|rest| rest.split('.').next());
    adapter.name.contains("llvmpipe")
        && version.and_then(|major| major.parse().ok()).is_some_and(|v: u32| v < 24)
}

fn camera_advice(machine: &Machine) -> Vec<String> {
    let mut advice = Vec::new();
    match &machine.cameras {
        None => advice.push("to train on photographs without cameras, install pycolmap: make poses; or a colmap of 3.13 or newer".to_owned()),
        Some(PoseProgram { network: NetworkIsolation::None, .. }) => advice.push(
            "the system permits neither a network namespace nor a filter of system calls: COLMAP reads photographs with network access"
                .to_owned(),
        ),
        Some(_) => {}
    }
    if machine.ffmpeg.is_none() {
        advice.push("to train on videos, install ffmpeg: on Debian, apt-get install ffmpeg".to_owned());
    }
    advice
}

fn text(machine: &Machine) -> String {
    let mut lines =
        vec![format!("tcgs {}, {}, {} threads", machine.version, machine.system, machine.threads)];
    if machine.adapters.is_empty() {
        lines.push("no adapter".to_owned());
    }
    for adapter in &machine.adapters {
        let [smallest, largest] = adapter.subgroup_sizes;
        let usable = if adapter.usable { "" } else { "  (not usable)" };
        lines.push(format!("\n{}{usable}", adapter.name));
        lines.push(format!("  backend     {} ({})", adapter.backend, adapter.kind));
        lines.push(format!("  driver      {}", adapter.driver));
        lines.push(format!(
            "  buffers     {} MiB largest, {} MiB a binding, {} a kernel",
            adapter.max_buffer_bytes >> 20,
            adapter.max_binding_bytes >> 20,
            adapter.max_storage_buffers
        ));
        lines.push(format!(
            "  workgroups  {} invocations, {} KiB",
            adapter.max_workgroup_invocations,
            adapter.max_workgroup_bytes >> 10
        ));
        lines.push(format!(
            "  subgroups   {}",
            if adapter.subgroups { format!("{smallest} to {largest}") } else { "none".to_owned() }
        ));
        lines.push(format!("  timestamps  {}", if adapter.timestamps { "yes" } else { "no" }));
    }
    let cameras = machine.cameras.as_ref().map_or_else(
        || "none".to_owned(),
        |program| format!("{program}; kept off the network by: {}", program.network),
    );
    lines.push(format!("\ncameras     {cameras}"));
    lines.push(format!(
        "videos      {}",
        machine.ffmpeg.as_ref().map_or("none".to_owned(), |v| format!("ffmpeg {v}"))
    ));
    lines.extend(machine.advice.iter().map(|advice| format!("\nadvice: {advice}")));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use tcgs::gpu::KernelVariant;

    use super::*;

    fn lavapipe(driver: &str) -> AdapterReport {
        AdapterReport {
            name: "llvmpipe (LLVM 15.0.6, 256 bits)".to_owned(),
            backend: "vulkan".to_owned(),
            kind: "cpu".to_owned(),
            driver: driver.to_owned(),
            max_buffer_bytes: 2_147_483_647,
            max_binding_bytes: 134_217_728,
            max_storage_buffers: 1_000_000,
            max_workgroup_invocations: 1024,
            max_workgroup_bytes: 32_768,
            subgroup_sizes: [8, 8],
            subgroups: true,
            timestamps: true,
            usable: true,
            variant: KernelVariant::Software,
        }
    }

    #[test]
    fn a_variable_that_chooses_no_adapter_is_named() {
        let adapters = [lavapipe("llvmpipe Mesa 25.0.7-2 (LLVM 19.1.7)")];
        let unmatched = |name: &str| unmatched_choice(&adapters, Some(name.to_owned()));
        for name in ["", "auto", "lavapipe", "LLVM 15"] {
            assert_eq!(unmatched(name), None, "{name}");
        }
        assert_eq!(unmatched_choice(&adapters, None), None);
        let detail = unmatched("RTX 4090").expect("none");
        assert!(detail.contains("TCGS_ADAPTER is 'RTX 4090'"), "{detail}");
        let [usable] = adapters;
        assert!(
            unmatched_choice(&[AdapterReport { usable: false, ..usable }], Some("auto".to_owned())).is_some()
        );
    }

    #[test]
    fn advice_is_given_where_something_can_be_done_and_only_there() {
        assert!(advice(&[lavapipe("llvmpipe Mesa 25.0.7-2 (LLVM 19.1.7)")], true).is_empty());
        let old = advice(&[lavapipe("llvmpipe Mesa 22.3.6 (LLVM 15.0.6)")], true);
        assert!(old.len() == 1 && old[0].contains("backports"), "{old:?}");
        let none = advice(&[], true);
        assert!(none.len() == 1 && none[0].contains("mesa-vulkan-drivers"), "{none:?}");
    }
}
