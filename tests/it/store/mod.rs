//! The store: jobs, datasets, totals and garbage collection on a manual clock, on both databases, and databases of earlier versions.

mod backup;
mod migrations;
#[path = "contract.rs"]
mod postgres;
mod postgres_server;
#[expect(clippy::duplicate_mod, reason = "one suite, on two databases")]
#[path = "contract.rs"]
mod sqlite;
