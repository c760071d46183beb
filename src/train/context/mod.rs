//! The context model in training: what it predicts, what the prediction costs in bits, and the quantisation that it is
//! trained through (method.md §4).

mod networks;
mod quantise;
mod rate;

pub use networks::RoundedNetworks;
pub(super) use quantise::scramble;
pub use quantise::{Quantisation, QuantisationPhase, QuantisedRows};
pub use rate::{AnchorSample, GroupOutputs, RateTerm};
