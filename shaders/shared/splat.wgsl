#define_import_path tcgs::splat

// A Gaussian on the image plane is three vectors:
// - place: center in pixels (xy), effective opacity (z), level, the power at which alpha falls below 1/255 (w);
// - conic: A, B, C with power = 0.5 (A dx^2 + C dy^2) + B dx dy (xyz), horizontal half extent in pixels (w);
// - color: red, green, blue (xyz), vertical half extent in pixels (w).

// Marks an empty list entry.
const NONE: u32 = 0xffffffffu;
// The place of an empty entry: it touches nothing.
const NOWHERE: vec4f = vec4f(0.0, 0.0, 0.0, -1.0);
const ALPHA_MIN: f32 = 1.0 / 255.0;
const ALPHA_MAX: f32 = 0.99;
const TRANSMITTANCE_MIN: f32 = 1e-4;
// Slack of the rectangle tests, so that rounding never drops a pixel.
const LEVEL_SLACK: f32 = 0.01;

fn power_at(conic: vec3f, d: vec2f) -> f32 {
    return 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
}

// Where the power is smallest along a line: at x = ridges.x * y of a horizontal line, at y = ridges.y * x of a vertical one.
fn ridges_of(conic: vec3f) -> vec2f {
    return -conic.y / conic.xz;
}

// Whether the splat reaches alpha 1/255 anywhere in the rectangle of pixel centers from `low` to `high`: the least
// power in a rectangle lies at the center or on an edge that faces it.
fn touches(place: vec4f, conic: vec3f, ridges: vec2f, low: vec2f, high: vec2f) -> bool {
    let near = low - place.xy;
    let far = high - place.xy;
    let nearest = clamp(vec2f(0.0), near, far);
    let along_y = clamp(ridges.y * nearest.x, near.y, far.y);
    let along_x = clamp(ridges.x * nearest.y, near.x, far.x);
    let least = min(
        power_at(conic, vec2f(nearest.x, along_y)),
        power_at(conic, vec2f(along_x, nearest.y)),
    );
    return least <= place.w + LEVEL_SLACK;
}

// Tiles [first, end) in both directions that the extents reach.
fn tile_bounds(place: vec2f, extent: vec2f, tiles: vec2u) -> vec4u {
    let limit = vec2f(tiles);
    let first = clamp(ceil((place - extent - 15.5) / 16.0), vec2f(0.0), limit);
    let end = clamp(floor((place + extent - 0.5) / 16.0) + 1.0, vec2f(0.0), limit);
    return vec4u(vec2u(first), vec2u(max(first, end)));
}

fn touches_tile(place: vec4f, conic: vec3f, ridges: vec2f, tile: vec2u) -> bool {
    let low = vec2f(tile * 16u) + 0.5;
    return touches(place, conic, ridges, low, low + 15.0);
}
