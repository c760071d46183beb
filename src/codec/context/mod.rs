//! The context model: what a decoder expects of an anchor's attributes, given what it already has.
//!
//! Everything from cells to distributions is integer arithmetic with proved ranges, so that every machine computes the
//! same. Geometry (where an anchor lies on the planes, who its neighbours are) is public: training uses the very same
//! integers as floats, and so sees what a decoder will see.

mod channels;
mod choice;
mod frame;
mod neighbours;
mod position;
mod texels;

pub(super) use channels::{Attribute, ChannelModel, Shape, SymbolModel};

pub use choice::{ContextChoice, ContextSearch, ContextSettings, GroupChoice};
pub use frame::{COORDINATE_LIMIT, coordinates, robust_frame};
pub use neighbours::neighbours;
pub use position::position_inputs;
pub use texels::{Texel, texels};
