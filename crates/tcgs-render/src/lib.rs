//! Gaussian splatting on any wgpu adapter: the [`gpu`], forward and backward passes, the f64 twin of every kernel, and rendering of
//! finished scenes.
//!
//! Whatever returns a [`RenderError`] can fail with a fault of the device; sections of errors name what else there is.

#![warn(missing_docs)]

mod dense;
mod dense_layer;
mod dense_software;
mod depth;
mod device_anchors;
mod error;
mod gaussians;
pub mod gpu;
pub mod model;
mod neural;
mod packed_image;
mod plain;
mod projection;
mod raster_buffers;
mod rasterizer;
mod renderer;
mod scene_viewer;
pub mod twin;
pub mod views;

pub use dense::DenseLayers;
pub use dense_layer::{Activation, Columns, DenseLayer, InputGradient, WeightGradient};
pub use depth::DepthShader;
pub use device_anchors::{AnchorGradients, DeviceAnchors};
pub use error::RenderError;
use error::Result;
pub use gaussians::{GEOMETRY_SECTIONS, GaussianGradients, Gaussians};
pub use neural::{NeuralGaussians, list_visible};
pub use packed_image::PackedImage;
pub use plain::{DeviceGaussians, PlainGaussians, STATISTICS};
pub use projection::{Projection, RasterSettings, TILE};
pub use rasterizer::{CorrectionRows, ForwardPasses, RasterCounts, Rasterizer, sum_slots};
#[cfg(target_arch = "wasm32")]
pub use renderer::PageRenderer;
pub use renderer::{Renderer, Views};
pub use scene_viewer::SceneViewer;
pub use views::RenderViews;

use tcgs_codec::domain;

/// The example of the readme compiles.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
