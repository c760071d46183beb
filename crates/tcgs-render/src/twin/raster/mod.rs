//! From Gaussians to pixels and back (METHOD.md §3).

mod clear_culled;
mod compact;
mod contribution;
mod emit;
mod gather;
mod project;
mod project_backward;
mod projected_covariance;
mod raster_backward;
mod raster_forward;
mod removal_loss;
mod rotation;
mod tile_counts;
mod tile_lists;
mod tile_ranges;
mod touched_tiles;

pub use clear_culled::clear_culled;
pub use compact::compact;
pub use emit::emit;
pub use gather::gather;
pub use project::project;
pub use project_backward::project_backward;
pub use raster_backward::raster_backward;
pub use raster_forward::{BlendedImage, raster_forward};
pub use removal_loss::removal_loss;
pub use rotation::rotation;
pub use tile_counts::tile_counts;
pub use tile_lists::{TileLists, tile_lists};
pub use tile_ranges::tile_ranges;
pub use touched_tiles::touches;
