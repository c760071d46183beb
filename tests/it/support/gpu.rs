//! One open device per test process.

use std::sync::{Arc, OnceLock};

use tcgs::gpu::{AdapterChoice, Context};

/// The device of `TCGS_ADAPTER`, lavapipe unless told.
pub fn gpu() -> Arc<Context> {
    static CONTEXT: OnceLock<Arc<Context>> = OnceLock::new();
    Arc::clone(CONTEXT.get_or_init(|| {
        let choice: AdapterChoice =
            std::env::var("TCGS_ADAPTER").map_or(AdapterChoice::Lavapipe, |name| match name.parse() {
                Ok(choice) => choice,
                Err(never) => match never {},
            });
        Context::new(&choice).expect("an adapter; install mesa-vulkan-drivers or set TCGS_ADAPTER")
    }))
}
