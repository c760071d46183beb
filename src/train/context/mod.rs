//! The context model in training (TC-GS II-B and II-D, METHOD.md §4.2 to §4.6): planes, neighbours and the
//! networks that expect an anchor's attributes of them, what those attributes then cost, and the quantisation that all of
//! it is trained through.
//!
//! What always holds: what a network is given of an anchor follows from integers that the codec has too; every sum has a
//! fixed order, so the same state, sample and adapter give the same bits; and parameters change in
//! [`ContextNet::step`] and [`ContextNet::latents_from_planes`] alone.

mod anchor_sample;
mod anchor_tables;
mod config;
mod convolution;
mod layout;
mod net;
mod plane_sampling;
mod planes;
mod quantise;
mod rate;
mod render_networks;
mod weights;

pub use anchor_sample::sample_anchors;
pub(super) use anchor_sample::sample_size;
pub use anchor_tables::ContextAnchors;
pub use config::{ContextConfig, PlaneConfig};
pub use layout::{ContextLayout, ContextLearningRates, ConvSpec, GroupStatistics};
pub use net::{ContextNet, ContextPass, ContextState};
pub use planes::PlaneSource;
pub(super) use quantise::pcg_hash;
pub use quantise::{Quantisation, QuantisationPhase, QuantisedRows};
pub use rate::{AnchorSample, GroupOutputs, RateInputs, RateTerm};
pub use render_networks::RoundedNetworks;
