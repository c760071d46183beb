//! What a picture shows: colors in 8 bits, and depth.

mod pack_image;
mod shade_depth;

pub use pack_image::pack_image;
pub use shade_depth::shade_depth;
