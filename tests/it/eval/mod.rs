//! Measures: LPIPS against its package, and the costs of removal against removal itself.

mod lpips;
mod removal;
