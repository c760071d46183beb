//! Splatting: forward, backward, and the f64 CPU twin of every kernel; rendering of finished scenes by pose.

pub mod views;

pub use views::RenderViews;
