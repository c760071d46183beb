//! The context model in training (TC-GS II-B and II-D, METHOD.md §4.2 to §4.6): planes, neighbors, the networks
//! that predict the distribution of an anchor's attributes, the bits that those then take, and the quantization in between.
//!
//! Networks get only inputs that follow from integers which the codec has too. Every sum has a fixed order, so the same state,
//! sample and adapter give the same bits. Parameters change in [`ContextNet::step`] and
//! [`ContextNet::latents_from_planes`] alone.

mod anchor_sample;
mod anchor_tables;
mod config;
mod convolution;
mod layout;
mod net;
mod plane_sampling;
mod planes;
mod quantize;
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
pub(super) use quantize::pcg_hash;
pub use quantize::{Quantization, QuantizationPhase, QuantizedRows};
pub use rate::{AnchorSample, RateInputs, RateTerm, SampleOutputs};
pub use render_networks::RoundedNetworks;
