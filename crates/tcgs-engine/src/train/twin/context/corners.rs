//! The bilinear sample of a plane.

/// The bilinear sample of one channel of a plane, as texels with weights. A place is a texel's word of
/// [`ContextAnchors`](crate::train::context::ContextAnchors).
pub(super) fn corners(texel: u32, edge: usize) -> [(usize, f64); 4] {
    let [x, y, fx, fy] = texel.to_le_bytes();
    let (x, y) = (usize::from(x), usize::from(y));
    let (fx, fy) = (f64::from(fx) / 256.0, f64::from(fy) / 256.0);
    let (right, below) = ((x + 1).min(edge - 1), (y + 1).min(edge - 1));
    [
        (y * edge + x, (1.0 - fx) * (1.0 - fy)),
        (y * edge + right, fx * (1.0 - fy)),
        (below * edge + x, (1.0 - fx) * fy),
        (below * edge + right, fx * fy),
    ]
}
