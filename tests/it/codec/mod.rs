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
mod rounding;
mod synthetic;
mod versions;
mod wire;
