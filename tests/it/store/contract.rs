//! What holds on either database; the name of this module says which one is tested.

mod datasets;
mod garbage;
mod queue;
pub(super) mod totals;

use crate::support::database::Database;

/// A database for one test; says that the test is skipped if there is none.
async fn database() -> Option<Database> {
    Database::for_module(module_path!()).await
}
