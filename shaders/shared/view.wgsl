#define_import_path tcgs::view

// A camera, its image and the settings of the rasterizer.
struct View {
    // Rows of the world-to-camera rotation; w is the image of `eye`.
    right: vec4f,
    down: vec4f,
    forward: vec4f,
    // The camera center, rounded.
    eye: vec4f,
    background: vec4f,
    focal: vec2f,
    center: vec2f,
    // Bounds of x/z and y/z inside the Jacobian.
    slope_low: vec2f,
    slope_high: vec2f,
    size: vec2u,
    tiles: vec2u,
    near: f32,
    low_pass: f32,
    antialiased: u32,
    gaussian_capacity: u32,
    intersection_capacity: u32,
}

// Camera coordinates of a world point. The difference to a point near the camera is exact, however far both are from the
// origin; a translation would be a number as large as that distance, and the sum would cancel.
fn to_camera(view: View, mean: vec3f) -> vec3f {
    let d = mean - view.eye.xyz;
    return vec3f(dot(view.right.xyz, d), dot(view.down.xyz, d), dot(view.forward.xyz, d))
        + vec3f(view.right.w, view.down.w, view.forward.w);
}

// Elements of the rasterizer's counters: pairs that the first overflowed pass required, or 0; passes completed before it;
// Gaussians that touch a tile; pairs of the last pass.
const REQUIRED: u32 = 0u;
const COMPLETED: u32 = 1u;
const VISIBLE: u32 = 2u;
const INTERSECTIONS: u32 = 3u;

// Side of a tile in pixels.
const TILE: u32 = 16u;

// Pixel of the tile for an invocation index, in Z order: any aligned power of two of indices is a compact block, so the
// lanes of a subgroup cover nearby pixels.
fn tile_pixel(index: u32) -> vec2u {
    var bits = vec2u(index, index >> 1u) & vec2u(0x55u);
    bits = (bits | (bits >> vec2u(1u))) & vec2u(0x33u);
    return (bits | (bits >> vec2u(2u))) & vec2u(0x0fu);
}
