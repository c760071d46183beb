//! What holds on either database; the name of this module says which one is tested.

mod bucket;
mod bucket_faults;
mod datasets;
mod exports;
mod finished_runs;
mod garbage;
#[expect(clippy::duplicate_mod, reason = "one suite, over a folder and over a bucket")]
#[path = "garbage.rs"]
mod garbage_in_bucket;
mod keys;
mod queue;
mod retention;
mod simulated_clock;
#[path = "../../../benches/store/simulation/mod.rs"]
mod simulation;
pub(super) mod totals;
mod viewers;
mod webhooks;

use crate::support::database::Database;

/// A database for one test; says that the test is skipped if there is none.
async fn database() -> Option<Database> {
    Database::for_module(module_path!()).await
}
