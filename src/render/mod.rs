//! Splatting: forward, backward, and the f64 CPU twin of every kernel; rendering of finished scenes by pose.

mod error;
mod gaussians;
mod projection;
mod rasterizer;
pub mod twin;
pub mod views;

pub use error::RenderError;
pub use gaussians::{GaussianGradients, Gaussians};
pub use projection::{Projection, RasterSettings, TILE};
pub use rasterizer::{Counts, Rasterizer};
pub use views::RenderViews;
