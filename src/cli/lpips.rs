//! The flag of the LPIPS weights, shared by all commands that measure.

use std::path::PathBuf;

/// Where the weights are, if there are any.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct LpipsFlag {
    /// Also measure LPIPS, with these weights of AlexNet or VGG16 (docs/CLI.md says how to write them)
    #[arg(long, value_name = "WEIGHTS.safetensors", env = "TCGS_LPIPS")]
    pub(crate) lpips: Option<PathBuf>,
}
