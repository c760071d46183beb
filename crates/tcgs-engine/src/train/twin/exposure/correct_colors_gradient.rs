//! The gradient of a corrected render.

use glam::{DVec3, DVec4};

/// The gradient by the render's pixels, and by the correction's rows, of a loss whose gradient by the corrected pixels is `d_corrected`.
#[must_use]
pub fn correct_colors_gradient(
    rows: &[DVec4; 3],
    render: &[DVec3],
    d_corrected: &[DVec3],
) -> (Vec<DVec3>, [DVec4; 3]) {
    let by_color = |d: &DVec3| rows[0].truncate() * d.x + rows[1].truncate() * d.y + rows[2].truncate() * d.z;
    let mut by_rows = [DVec4::ZERO; 3];
    for (color, d) in render.iter().zip(d_corrected) {
        for (row, d) in by_rows.iter_mut().zip(d.to_array()) {
            *row += d * color.extend(1.0);
        }
    }
    (d_corrected.iter().map(by_color).collect(), by_rows)
}
