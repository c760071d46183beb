//! The flag of the adapter, shared by all commands that render.

use tcgs::gpu::AdapterChoice;

/// Which adapter to use.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct AdapterFlag {
    /// auto, lavapipe, or a part of the adapter's name (see `tcgs doctor`)
    #[arg(long, value_name = "NAME", default_value_t = AdapterChoice::Auto, env = "TCGS_ADAPTER")]
    pub(crate) adapter: AdapterChoice,
}
