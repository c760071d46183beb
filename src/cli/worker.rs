//! `tcgs worker`: takes jobs from a queue and carries them out.

use std::path::PathBuf;

use super::{
    Failure, Report,
    adapter::AdapterFlag,
    wiring::{self, Queue, WorkerOptions},
};

/// Arguments of `tcgs worker`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The data folder of a service on this machine
    #[arg(long, value_name = "DIR", required_unless_present = "database", conflicts_with_all = ["database", "blobs"])]
    data: Option<PathBuf>,

    /// The database that holds the queue
    #[arg(long, value_name = "URL", requires = "blobs", env = "TCGS_DATABASE")]
    database: Option<String>,

    /// The storage that holds uploads and files
    #[arg(long, value_name = "URL", requires = "database", env = "TCGS_BLOBS")]
    blobs: Option<String>,

    #[command(flatten)]
    adapter: AdapterFlag,

    /// Stop when standard input closes: how a worker outlives its parent by moments only
    #[arg(long, hide = true)]
    stop_with_parent: bool,
}

/// Works until a signal comes.
pub(crate) fn run(args: Args) -> Result<Report, Failure> {
    let queue = match (args.data, args.database, args.blobs) {
        (Some(folder), _, _) => Queue::Folder(folder),
        (None, Some(database), Some(blobs)) => Queue::Shared { database, blobs },
        _ => return Err(Failure::Usage("give --data, or --database and --blobs".to_owned())),
    };
    wiring::worker(WorkerOptions {
        queue,
        adapter: args.adapter.adapter,
        stop_with_parent: args.stop_with_parent,
    })?;
    Ok(Report::default())
}
