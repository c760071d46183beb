// Gradients of `shade_gaussians`: from the Gaussians back to their parameters. A colour depends on the direction too, so
// its gradient reaches the mean; a channel clamped at zero has no gradient. Culled Gaussians get zeros.
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::plain::{
    View, BASE, LOG_SCALE, QUAT, OPACITY, COLOR, BAND_VALUES, DEGREE, SH_ZERO, bands_at, basis_of_one, basis_of_two,
    basis_of_three, ray_to, slope_of_one, slope_of_two, slope_of_three,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> bands: array<f32>;
@group(0) @binding(2) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read> colors: array<vec4f>;
@group(0) @binding(4) var<storage, read> d_geometry: array<vec4f>;
@group(0) @binding(5) var<storage, read> d_colors: array<vec4f>;
@group(0) @binding(6) var<storage, read> d_centers: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> d_base: array<f32>;
@group(0) @binding(8) var<storage, read_write> d_bands: array<f32>;

fn coefficient(at: u32) -> vec3f {
    return vec3f(bands[at], bands[at + 1u], bands[at + 2u]);
}

fn store(at: u32, value: vec3f) {
    d_bands[at] = value.x;
    d_bands[at + 1u] = value.y;
    d_bands[at + 2u] = value.z;
}

fn store_base(at: u32, value: vec3f) {
    d_base[at] = value.x;
    d_base[at + 1u] = value.y;
    d_base[at + 2u] = value.z;
}

fn clear(i: u32) {
    for (var k = 0u; k < BASE; k++) {
        d_base[i * BASE + k] = 0.0;
    }
    let at = bands_at(view, i);
    for (var k = 0u; DEGREE > 0u && k < BAND_VALUES.x; k++) {
        d_bands[at.x + k] = 0.0;
    }
    for (var k = 0u; DEGREE > 1u && k < BAND_VALUES.y; k++) {
        d_bands[at.y + k] = 0.0;
    }
    for (var k = 0u; DEGREE > 2u && k < BAND_VALUES.z; k++) {
        d_bands[at.z + k] = 0.0;
    }
}

// The gradient by the direction; those by the coefficients are stored.
fn by_direction(i: u32, d: vec3f, v: vec3f) -> vec3f {
    let at = bands_at(view, i);
    let b = basis_of_one(d);
    let w = vec3f(
        dot(coefficient(at.x), v),
        dot(coefficient(at.x + 3u), v),
        dot(coefficient(at.x + 6u), v),
    );
    store(at.x, b.x * v);
    store(at.x + 3u, b.y * v);
    store(at.x + 6u, b.z * v);
    var slope = slope_of_one(w);
    if DEGREE > 1u {
        let b = basis_of_two(d);
        slope += slope_of_two(d, array<f32, 5>(
            dot(coefficient(at.y), v),
            dot(coefficient(at.y + 3u), v),
            dot(coefficient(at.y + 6u), v),
            dot(coefficient(at.y + 9u), v),
            dot(coefficient(at.y + 12u), v),
        ));
        store(at.y, b[0] * v);
        store(at.y + 3u, b[1] * v);
        store(at.y + 6u, b[2] * v);
        store(at.y + 9u, b[3] * v);
        store(at.y + 12u, b[4] * v);
    }
    if DEGREE > 2u {
        let b = basis_of_three(d);
        slope += slope_of_three(d, array<f32, 7>(
            dot(coefficient(at.z), v),
            dot(coefficient(at.z + 3u), v),
            dot(coefficient(at.z + 6u), v),
            dot(coefficient(at.z + 9u), v),
            dot(coefficient(at.z + 12u), v),
            dot(coefficient(at.z + 15u), v),
            dot(coefficient(at.z + 18u), v),
        ));
        store(at.z, b[0] * v);
        store(at.z + 3u, b[1] * v);
        store(at.z + 6u, b[2] * v);
        store(at.z + 9u, b[3] * v);
        store(at.z + 12u, b[4] * v);
        store(at.z + 15u, b[5] * v);
        store(at.z + 18u, b[6] * v);
    }
    return slope;
}

@compute @workgroup_size(64)
fn shade_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = (group.x + group.y * 65535u) * 64u + local;
    if i >= view.count {
        return;
    }
    if !(d_centers[i].z > 0.0) {
        clear(i);
        return;
    }
    let mean_opacity = geometry[i];
    let d = d_geometry[i];
    let v = select(vec3f(0.0), d_colors[i].xyz, colors[i].xyz > vec3f(0.0));
    var d_mean = d.xyz;
    if DEGREE > 0u {
        let ray = ray_to(view, mean_opacity.xyz);
        let inverse_distance = inverseSqrt(dot(ray, ray));
        let direction = ray * inverse_distance;
        let slope = by_direction(i, direction, v);
        d_mean += (slope - direction * dot(direction, slope)) * inverse_distance;
    }
    let row = i * BASE;
    store_base(row, d_mean);
    let scale = scale_row(view.count, i);
    store_base(row + LOG_SCALE, d_geometry[scale].xyz * geometry[scale].xyz);
    let d_quat = d_geometry[quat_row(view.count, i)];
    d_base[row + QUAT] = d_quat.x;
    d_base[row + QUAT + 1u] = d_quat.y;
    d_base[row + QUAT + 2u] = d_quat.z;
    d_base[row + QUAT + 3u] = d_quat.w;
    d_base[row + OPACITY] = d.w * mean_opacity.w * (1.0 - mean_opacity.w);
    store_base(row + COLOR, SH_ZERO * v);
}
