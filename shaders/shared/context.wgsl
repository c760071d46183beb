// Geometry of the context model: texels and their bilinear weights.
#define_import_path tcgs::context

// Values of the position prior.
const PRIORS: u32 = 18u;

// A texel's word: x, y, then the fractions along x and y in 256ths, a byte each.
fn place(texel: u32) -> vec2u {
    return vec2u(texel, texel >> 8u) & vec2u(255u);
}

// The four texels of a bilinear sample: at it, one along x, one along y, one along both; clamped at the edge.
fn corners(texel: u32, edge: u32) -> vec4u {
    let low = place(texel);
    let high = min(low + 1u, vec2u(edge - 1u));
    return vec4u(low.y, low.y, high.y, high.y) * edge + vec4u(low.x, high.x, low.x, high.x);
}

// Their bilinear weights.
fn sample_weights(texel: u32) -> vec4f {
    let f = vec2f(vec2u(texel >> 16u, texel >> 24u) & vec2u(255u)) * 0.00390625;
    let g = 1.0 - f;
    return vec4f(g.x * g.y, f.x * g.y, g.x * f.y, f.x * f.y);
}
