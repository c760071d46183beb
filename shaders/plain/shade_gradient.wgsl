// Gradients of `shade_gaussians`: from the Gaussians back to their parameters. A color depends on the direction too, so
// its gradient reaches the mean; a channel clamped at zero has no gradient. Culled Gaussians get zeros.
//
// On hardware, the rows of a workgroup's Gaussians pass through workgroup memory, so that neighboring lanes read and write
// neighboring values; the gradients replace the coefficients there.
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::harmonics::{
    SH_ZERO, basis_of_one, basis_of_two, basis_of_three, slope_of_one, slope_of_two, slope_of_three,
}
#import tcgs::index::group_index
#import tcgs::plain::{View, BASE, LOG_SCALE, QUAT, OPACITY, COLOR, BAND_VALUES, DEGREE, bands_at, ray_to}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> bands: array<f32>;
@group(0) @binding(2) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read> colors: array<vec4f>;
@group(0) @binding(4) var<storage, read> d_geometry: array<vec4f>;
@group(0) @binding(5) var<storage, read> d_colors: array<vec4f>;
@group(0) @binding(6) var<storage, read> d_centers: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> d_base: array<f32>;
@group(0) @binding(8) var<storage, read_write> d_bands: array<f32>;

const LANES: u32 = 64u;

#ifdef SOFTWARE
fn coefficient(at: u32) -> vec3f {
    return vec3f(bands[at], bands[at + 1u], bands[at + 2u]);
}

fn put(at: u32, value: f32) {
    d_bands[at] = value;
}

fn put_base(at: u32, value: f32) {
    d_base[at] = value;
}

// Where the base values of a Gaussian begin.
fn base_row(i: u32) -> u32 {
    return i * BASE;
}

// Where its coefficients of each degree begin.
fn band_rows(i: u32) -> vec3u {
    return bands_at(view, i);
}
#else
// Coefficients of a Gaussian in use.
const COEFFICIENTS: u32 = 3u * ((DEGREE + 1u) * (DEGREE + 1u) - 1u);
// One more than the base values of a Gaussian, so that lanes in line use different banks.
const BASE_PITCH: u32 = BASE + 1u;

// The coefficients of the workgroup's Gaussians by degree, then their gradients. One value more, since no array is empty.
var<workgroup> staged: array<f32, LANES * COEFFICIENTS + 1u>;
var<workgroup> staged_base: array<f32, LANES * BASE_PITCH>;

fn coefficient(at: u32) -> vec3f {
    return vec3f(staged[at], staged[at + 1u], staged[at + 2u]);
}

fn put(at: u32, value: f32) {
    staged[at] = value;
}

fn put_base(at: u32, value: f32) {
    staged_base[at] = value;
}

fn base_row(i: u32) -> u32 {
    return i % LANES * BASE_PITCH;
}

fn band_rows(i: u32) -> vec3u {
    return LANES * vec3u(0u, BAND_VALUES.x, BAND_VALUES.x + BAND_VALUES.y) + i % LANES * BAND_VALUES;
}

// Reads the coefficients of `count` Gaussians from `first` on.
fn read_rows(first: u32, count: u32, local: u32) {
    let source = bands_at(view, first);
    let staged_at = band_rows(0u);
    for (var k = local; DEGREE > 0u && k < count * BAND_VALUES.x; k += LANES) {
        staged[staged_at.x + k] = bands[source.x + k];
    }
    for (var k = local; DEGREE > 1u && k < count * BAND_VALUES.y; k += LANES) {
        staged[staged_at.y + k] = bands[source.y + k];
    }
    for (var k = local; DEGREE > 2u && k < count * BAND_VALUES.z; k += LANES) {
        staged[staged_at.z + k] = bands[source.z + k];
    }
}

// Writes the gradients of `count` Gaussians from `first` on.
fn write_rows(first: u32, count: u32, local: u32) {
    for (var k = local; k < count * BASE; k += LANES) {
        d_base[first * BASE + k] = staged_base[k + k / BASE];
    }
    let to = bands_at(view, first);
    let staged_at = band_rows(0u);
    for (var k = local; DEGREE > 0u && k < count * BAND_VALUES.x; k += LANES) {
        d_bands[to.x + k] = staged[staged_at.x + k];
    }
    for (var k = local; DEGREE > 1u && k < count * BAND_VALUES.y; k += LANES) {
        d_bands[to.y + k] = staged[staged_at.y + k];
    }
    for (var k = local; DEGREE > 2u && k < count * BAND_VALUES.z; k += LANES) {
        d_bands[to.z + k] = staged[staged_at.z + k];
    }
}
#endif

fn store(at: u32, value: vec3f) {
    put(at, value.x);
    put(at + 1u, value.y);
    put(at + 2u, value.z);
}

fn store_base(at: u32, value: vec3f) {
    put_base(at, value.x);
    put_base(at + 1u, value.y);
    put_base(at + 2u, value.z);
}

fn clear(i: u32) {
    let row = base_row(i);
    for (var k = 0u; k < BASE; k++) {
        put_base(row + k, 0.0);
    }
    let at = band_rows(i);
    for (var k = 0u; DEGREE > 0u && k < BAND_VALUES.x; k++) {
        put(at.x + k, 0.0);
    }
    for (var k = 0u; DEGREE > 1u && k < BAND_VALUES.y; k++) {
        put(at.y + k, 0.0);
    }
    for (var k = 0u; DEGREE > 2u && k < BAND_VALUES.z; k++) {
        put(at.z + k, 0.0);
    }
}

// The gradient by the direction; those by the coefficients are stored.
fn by_direction(i: u32, d: vec3f, v: vec3f) -> vec3f {
    let at = band_rows(i);
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

fn differentiate(i: u32) {
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
    let row = base_row(i);
    store_base(row, d_mean);
    let scale = scale_row(view.count, i);
    store_base(row + LOG_SCALE, d_geometry[scale].xyz * geometry[scale].xyz);
    let d_quat = d_geometry[quat_row(view.count, i)];
    store_base(row + QUAT, d_quat.xyz);
    put_base(row + QUAT + 3u, d_quat.w);
    put_base(row + OPACITY, d.w * mean_opacity.w * (1.0 - mean_opacity.w));
    store_base(row + COLOR, SH_ZERO * v);
}

@compute @workgroup_size(LANES)
fn shade_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let first = group_index(group) * LANES;
    // Uniform: all invocations of a workgroup return here or none.
    if first >= view.count {
        return;
    }
#ifdef SOFTWARE
    if first + local < view.count {
        differentiate(first + local);
    }
#else
    let count = min(LANES, view.count - first);
    read_rows(first, count, local);
    workgroupBarrier();
    if local < count {
        differentiate(first + local);
    }
    workgroupBarrier();
    write_rows(first, count, local);
#endif
}
