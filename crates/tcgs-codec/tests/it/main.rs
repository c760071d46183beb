//! The codec through its public face: round trips, golden file, versions, hostile bytes.

mod context;
mod corpus;
mod dependent;
mod figures;
mod fixtures;
mod golden;
mod hostile;
mod inspection;
mod regression;
mod round_trip;
#[allow(dead_code, unreachable_pub, reason = "as the service's tests use it")]
#[path = "../../../../tests/it/support/skip.rs"]
mod skip;
mod synthetic;
mod versions;
mod wire;
