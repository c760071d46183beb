//! `tcgs worker`: takes jobs from a queue and carries them out.

use std::time::Duration;

use super::{
    CliError, Report,
    adapter::AdapterFlag,
    camera_search::CameraFlags,
    config::ConfigFlags,
    limits::duration,
    lpips::LpipsFlag,
    memory::MemoryFlags,
    priority::WorkerPriorityFlag,
    projects::MaxRunningFlag,
    storage::StorageFlags,
    wiring::{self, WorkerOptions},
};

/// Arguments of `tcgs worker`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(crate) config: ConfigFlags,

    #[command(flatten)]
    storage: StorageFlags,

    #[command(flatten)]
    adapter: AdapterFlag,

    #[command(flatten)]
    memory: MemoryFlags,

    #[command(flatten)]
    lpips: LpipsFlag,

    #[command(flatten)]
    cameras: CameraFlags,

    #[command(flatten)]
    nice: WorkerPriorityFlag,

    #[command(flatten)]
    running: MaxRunningFlag,

    /// Stop when standard input closes, as it does when the service that started this worker ends
    #[arg(long, hide = true)]
    stop_with_parent: bool,

    /// Time between two checkpoints of a run; tests that kill workers want more of them
    #[arg(long, hide = true, env = "TCGS_CHECKPOINT_EVERY", value_parser = duration)]
    checkpoint_every: Option<Duration>,
}

/// Works until a signal comes.
pub(crate) fn run(args: Args) -> Result<Report, CliError> {
    args.nice.lower_priority()?;
    wiring::worker(WorkerOptions {
        storage: args.storage.storage()?,
        adapter: args.adapter.adapter,
        memory: args.memory.limits(1),
        lpips: args.lpips.lpips,
        cameras: args.cameras,
        max_running_jobs: args.running.max_running_jobs,
        stop_with_parent: args.stop_with_parent,
        checkpoint_every: args.checkpoint_every,
    })?;
    Ok(Report::default())
}
