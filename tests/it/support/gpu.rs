//! One open device per test process, and the adapter that it and child processes use.

use std::sync::{Arc, OnceLock};

use tcgs::gpu::{AdapterChoice, Context};

/// The adapter of `TCGS_ADAPTER`, lavapipe unless told.
pub fn choice() -> AdapterChoice {
    std::env::var("TCGS_ADAPTER").map_or(AdapterChoice::Lavapipe, |name| match name.parse() {
        Ok(choice) => choice,
        Err(never) => match never {},
    })
}

/// The device of [`choice`].
pub fn gpu() -> Arc<Context> {
    static CONTEXT: OnceLock<Arc<Context>> = OnceLock::new();
    Arc::clone(CONTEXT.get_or_init(|| {
        Context::new(&choice()).expect("an adapter; install mesa-vulkan-drivers or set TCGS_ADAPTER")
    }))
}
