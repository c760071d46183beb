#define_import_path tcgs::view

// A camera, its image and the settings of the rasteriser.
struct View {
    // Rows of the world-to-camera rotation; w is the translation.
    right: vec4<f32>,
    down: vec4<f32>,
    forward: vec4<f32>,
    background: vec4<f32>,
    focal: vec2<f32>,
    center: vec2<f32>,
    // Bounds of x/z and y/z inside the Jacobian.
    slope_low: vec2<f32>,
    slope_high: vec2<f32>,
    size: vec2<u32>,
    tiles: vec2<u32>,
    near: f32,
    low_pass: f32,
    antialiased: u32,
    gaussian_capacity: u32,
    intersection_capacity: u32,
}

// Elements of the rasteriser's counters: pairs that the first overflowed pass required, or 0; passes completed before it;
// Gaussians that touch a tile; pairs of the last pass.
const REQUIRED: u32 = 0u;
const COMPLETED: u32 = 1u;
const VISIBLE: u32 = 2u;
const INTERSECTIONS: u32 = 3u;

// Side of a tile in pixels.
const TILE: u32 = 16u;

// Pixel of the tile for an invocation index, in Z order: any aligned power of two of indices is a compact block, so the
// lanes of a subgroup cover nearby pixels.
fn tile_pixel(index: u32) -> vec2<u32> {
    var bits = vec2<u32>(index, index >> 1u) & vec2<u32>(0x55u);
    bits = (bits | (bits >> vec2<u32>(1u))) & vec2<u32>(0x33u);
    return (bits | (bits >> vec2<u32>(2u))) & vec2<u32>(0x0fu);
}
