//! The colors of a render as a correction makes them.

use glam::{DVec3, DVec4};

/// `A c + b` for every pixel.
#[must_use]
pub fn correct_colors(rows: &[DVec4; 3], render: &[DVec3]) -> Vec<DVec3> {
    render.iter().map(|color| DVec3::from(rows.map(|row| row.dot(color.extend(1.0))))).collect()
}
