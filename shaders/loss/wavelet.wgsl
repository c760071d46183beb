// The wavelet constraint: the weighted absolute bands of two Haar levels of render minus photograph (the transform is linear,
// so these are the differences of the bands). Adds its gradient to the image's and writes each block's partial loss after
// those of the other losses (TC-GS (6), METHOD.md §4.7). Both levels lie within blocks of 4 x 4 pixels:
// one block an invocation. Outside the image both are zero and need no gradient; so it is where a pixel does not count.

#import tcgs::index::lane_index

struct Constraint {
    // width, height, blocks in a row, blocks
    size: vec4u,
    // index of the first partial loss, unused, unused, unused
    places: vec4u,
    // weights of a sample of LH, HL and HH of the first level; the low band's place is 0
    fine: vec4f,
    // of LL, LH, HL and HH of the second
    coarse: vec4f,
}

// Of a 2 x 2 block, read along rows, to LL, LH, HL and HH. Symmetric and orthogonal: its own inverse and adjoint.
const HAAR: mat4x4f = mat4x4f(
    0.5, 0.5, 0.5, 0.5,
    0.5, 0.5, -0.5, -0.5,
    0.5, -0.5, 0.5, -0.5,
    0.5, -0.5, -0.5, 0.5,
);

@group(0) @binding(0) var<uniform> constraint: Constraint;
@group(0) @binding(1) var<storage, read> render: array<vec4f>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read_write> losses: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> d_image: array<vec4f>;

fn inside(place: vec2u) -> bool {
    return place.x < constraint.size.x && place.y < constraint.size.y;
}

// By the weight in the fourth byte of a pixel's word. Without masks all count.
fn counts(pixel: u32) -> bool {
#ifdef MASKED
    return photograph[pixel] >= 0xff000000u;
#else
    return true;
#endif
}

fn difference(place: vec2u) -> vec3f {
    let held = min(place, constraint.size.xy - 1u);
    let pixel = held.y * constraint.size.x + held.x;
    let packed = vec3u(photograph[pixel]) >> vec3u(0u, 8u, 16u);
    let seen = inside(place) && counts(pixel);
    return select(vec3f(0.0), render[pixel].xyz - vec3f(packed & vec3u(255u)) / 255.0, seen);
}

// The bands of a 2 x 2 block, a column each.
fn bands(place: vec2u) -> mat4x3f {
    return mat4x3f(
        difference(place),
        difference(place + vec2u(1u, 0u)),
        difference(place + vec2u(0u, 1u)),
        difference(place + vec2u(1u, 1u)),
    ) * HAAR;
}

fn total(band: vec3f) -> f32 {
    return abs(band.x) + abs(band.y) + abs(band.z);
}

fn loss(block: mat4x3f, weights: vec4f) -> f32 {
    return dot(weights, vec4f(total(block[0]), total(block[1]), total(block[2]), total(block[3])));
}

// The gradient of `loss` by the bands.
fn d_bands(block: mat4x3f, weights: vec4f) -> mat4x3f {
    return mat4x3f(
        weights.x * sign(block[0]),
        weights.y * sign(block[1]),
        weights.z * sign(block[2]),
        weights.w * sign(block[3]),
    );
}

fn add(place: vec2u, gradient: vec3f) {
    let pixel = place.y * constraint.size.x + place.x;
    if inside(place) && counts(pixel) {
        d_image[pixel] += vec4f(gradient, 0.0);
    }
}

fn add_block(place: vec2u, fine: mat4x3f, d_low: vec3f) {
    let d = d_bands(fine, constraint.fine);
    let gradient = mat4x3f(d_low, d[1], d[2], d[3]) * HAAR;
    add(place, gradient[0]);
    add(place + vec2u(1u, 0u), gradient[1]);
    add(place + vec2u(0u, 1u), gradient[2]);
    add(place + vec2u(1u, 1u), gradient[3]);
}

@compute @workgroup_size(64)
fn wavelet(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    if index >= constraint.size.w {
        return;
    }
    let row = index / constraint.size.z;
    let place = 4u * vec2u(index - row * constraint.size.z, row);
    let right = place + vec2u(2u, 0u);
    let below = place + vec2u(0u, 2u);
    let across = place + vec2u(2u, 2u);
    let a = bands(place);
    let b = bands(right);
    let c = bands(below);
    let d = bands(across);
    let coarse = mat4x3f(a[0], b[0], c[0], d[0]) * HAAR;
    let fine = loss(a, constraint.fine) + loss(b, constraint.fine) + loss(c, constraint.fine) + loss(d, constraint.fine);
    losses[constraint.places.x + index] = vec4f(0.0, 0.0, 0.0, fine + loss(coarse, constraint.coarse));
    let d_low = d_bands(coarse, constraint.coarse) * HAAR;
    add_block(place, a, d_low[0]);
    add_block(right, b, d_low[1]);
    add_block(below, c, d_low[2]);
    add_block(across, d, d_low[3]);
}
