//! `tcgs worker`: takes jobs from a queue and carries them out.

use std::path::PathBuf;

use super::{
    Failure, Report,
    adapter::AdapterFlag,
    config::ConfigFlags,
    lpips::LpipsFlag,
    memory::MemoryFlags,
    priority::NiceFlag,
    serve::refuse_shared_storage,
    wiring::{self, WorkerOptions},
};

/// Arguments of `tcgs worker`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    pub(crate) config: ConfigFlags,

    /// The data folder of a service on this machine
    #[arg(long, value_name = "DIR", default_value = "tcgs-data", env = "TCGS_DATA")]
    data: PathBuf,

    /// The database that holds the queue
    #[arg(long, value_name = "URL", env = "TCGS_DATABASE", hide = true)]
    database: Option<String>,

    /// The storage that holds uploads and files
    #[arg(long, value_name = "URL", env = "TCGS_BLOBS", hide = true)]
    blobs: Option<String>,

    #[command(flatten)]
    adapter: AdapterFlag,

    #[command(flatten)]
    memory: MemoryFlags,

    #[command(flatten)]
    lpips: LpipsFlag,

    #[command(flatten)]
    nice: NiceFlag,

    /// Stop when standard input closes, as it does when the service that started this worker ends
    #[arg(long, hide = true)]
    stop_with_parent: bool,
}

/// Works until a signal comes.
pub(crate) fn run(args: Args) -> Result<Report, Failure> {
    refuse_shared_storage(args.database.as_deref(), args.blobs.as_deref())?;
    args.nice.stand_back()?;
    wiring::worker(WorkerOptions {
        data: args.data,
        adapter: args.adapter.adapter,
        memory: args.memory.limits(1),
        lpips: args.lpips.lpips,
        stop_with_parent: args.stop_with_parent,
    })?;
    Ok(Report::default())
}
