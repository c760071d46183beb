//! The context model: what a decoder expects of an anchor's attributes, given what it already has.
//!
//! Everything from cells to distributions is integer arithmetic with proved ranges, so that every machine computes the
//! same. Geometry (where an anchor lies on the planes, who its neighbors are) is public: training uses the very same
//! integers as floats, and so sees what a decoder will see.

mod anchors;
mod choice;
mod dense;
pub(super) mod floats;
mod frame;
mod latents;
mod model;
mod neighbors;
mod planes;
mod position;
pub(super) mod quant_steps;
pub(super) mod regression;
pub(super) mod section;
mod stored;
mod texels;
mod upsampling;

pub(super) use anchors::AnchorContext;
pub(super) use dense::{IntegerMlp, WeightBits};
pub(super) use model::{BaseModel, ContextNetwork, GroupModel, Predictions};
pub(super) use planes::IntegerPlanes;
pub(super) use regression::{ChannelRegression, GroupRegression, Regressions};

pub use choice::{ContextChoice, ContextSearch, ContextSettings, GroupChoice, RegressionSearch};
pub use frame::{COORDINATE_LIMIT, coordinates, robust_frame};
pub use neighbors::neighbors;
pub use position::position_inputs;
pub use stored::{stored_network, stored_planes};
pub use texels::{Texel, texels};
