//! The context model in training (method.md §3.2, §4.3 to §4.9 with the mended points of §4.13): planes, neighbours and the
//! networks that expect an anchor's attributes of them.
//!
//! What always holds: what a network is given of an anchor follows from integers that the codec has too; every sum has a
//! fixed order, so the same state, sample and adapter give the same bits; and parameters change in
//! [`ContextNet::step`] and [`ContextNet::latents_from_planes`] alone.

mod anchors;
mod config;
mod conv;
mod error;
mod layout;
mod net;
mod planes;
mod sample;
mod sampling;
mod weights;

pub use anchors::ContextAnchors;
pub use config::{ContextConfig, PlaneConfig};
pub use error::ContextError;
pub use layout::{ContextLayout, ContextPart, ContextRates, ConvSpec, GroupStatistics};
pub use net::{ContextNet, ContextPass, ContextState, PlaneSource};
pub use sample::sample_anchors;
