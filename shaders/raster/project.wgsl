// Projects each Gaussian onto the image and counts the tiles it touches; zero tiles means culled.

#import tcgs::view::{View, to_camera}
#import tcgs::finite::all_finite
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::splat::{ALPHA_MIN, ridges_of, tile_bounds, touches_tile}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> count: array<u32>;
@group(0) @binding(2) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read> colors: array<vec4f>;
// Three vectors a Gaussian: place, conic, color.
@group(0) @binding(4) var<storage, read_write> splats: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> depths: array<u32>;
@group(0) @binding(6) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(7) var<storage, read_write> visible: array<u32>;

// Candidates that an invocation takes at a time, at most 32.
const RUN: u32 = #{RUN}u;

fn project_one(i: u32) -> u32 {
    let mean_opacity = geometry[i];
    let scale = geometry[scale_row(view.gaussian_capacity, i)].xyz;
    let raw = geometry[quat_row(view.gaussian_capacity, i)];
    let color = colors[i].xyz;
    if !all_finite(mean_opacity) || !all_finite(vec4f(scale, 0.0)) || !all_finite(raw) || !all_finite(vec4f(color, 0.0)) {
        return 0u;
    }
    let t = to_camera(view, mean_opacity.xyz);
    let norm = dot(raw, raw);
    if !all_finite(vec4f(t, norm)) || !(t.z > view.near) || !(norm > 1e-30) {
        return 0u;
    }
    let q = raw * inverseSqrt(norm);
    let w = q.x;
    let v = q.yzw;
    // Columns of the rotation, scaled.
    let ax = scale.x * vec3f(
        1.0 - 2.0 * (v.y * v.y + v.z * v.z),
        2.0 * (v.x * v.y + w * v.z),
        2.0 * (v.x * v.z - w * v.y),
    );
    let ay = scale.y * vec3f(
        2.0 * (v.x * v.y - w * v.z),
        1.0 - 2.0 * (v.x * v.x + v.z * v.z),
        2.0 * (v.y * v.z + w * v.x),
    );
    let az = scale.z * vec3f(
        2.0 * (v.x * v.z + w * v.y),
        2.0 * (v.y * v.z - w * v.x),
        1.0 - 2.0 * (v.x * v.x + v.y * v.y),
    );
    let rz = 1.0 / t.z;
    let slope = clamp(t.xy * rz, view.slope_low, view.slope_high);
    let row_u = view.focal.x * rz * (view.right.xyz - slope.x * view.forward.xyz);
    let row_v = view.focal.y * rz * (view.down.xyz - slope.y * view.forward.xyz);
    let nu = vec3f(dot(row_u, ax), dot(row_u, ay), dot(row_u, az));
    let nv = vec3f(dot(row_v, ax), dot(row_v, ay), dot(row_v, az));
    // The determinant of N N^T as a sum of squares: no cancellation, however thin the Gaussian.
    let normal = cross(nu, nv);
    let sharp = dot(normal, normal);
    let trace = dot(nu, nu) + dot(nv, nv);
    let a = dot(nu, nu) + view.low_pass;
    let b = dot(nu, nv);
    let c = dot(nv, nv) + view.low_pass;
    let determinant = sharp + view.low_pass * (trace + view.low_pass);
    if !(determinant > 0.0) {
        return 0u;
    }
    var opacity = mean_opacity.w;
    if view.antialiased != 0u {
        opacity *= sqrt(max(0.005 * 0.005, sharp / determinant));
    }
    if !(opacity >= ALPHA_MIN) {
        return 0u;
    }
    let level = log(255.0 * opacity);
    let center = view.focal * t.xy * rz + view.center;
    let extent = sqrt(2.0 * max(level, 0.0) * vec2f(a, c)) * 1.001 + 0.05;
    let place = vec4f(center, opacity, level);
    let conic = vec3f(c, -b, a) / determinant;
    if !all_finite(place) || !all_finite(vec4f(conic, extent.x)) || !all_finite(vec4f(extent.y, rz, 0.0, 0.0))
        || !(conic.x > 0.0) || !(conic.z > 0.0) {
        return 0u;
    }
    let bounds = tile_bounds(center, extent, view.tiles);
    let ridges = ridges_of(conic);
    var touched = 0u;
    for (var y = bounds.y; y < bounds.w; y++) {
        for (var x = bounds.x; x < bounds.z; x++) {
            touched += u32(touches_tile(place, conic, ridges, vec2u(x, y)));
        }
    }
    splats[3u * i] = place;
    splats[3u * i + 1u] = vec4f(conic, extent.x);
    splats[3u * i + 2u] = vec4f(color, extent.y);
    depths[i] = bitcast<u32>(t.z);
    return touched;
}

@compute @workgroup_size(64)
fn project(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
    let total = min(count[0], view.gaussian_capacity);
#if RUN > 1
    // Of many candidates few are opaque. Lanes of a software adapter that have none cost as much as those that have one, so each
    // takes a run of candidates and projects the opaque ones; antialiasing makes none more opaque.
    for (var first = begin * RUN; first < total; first += groups.x * 64u * RUN) {
        var opaque = 0u;
        for (var k = 0u; k < min(RUN, total - first); k++) {
            if geometry[first + k].w >= ALPHA_MIN {
                opaque |= 1u << k;
            } else {
                tiles[first + k] = 0u;
                visible[first + k] = 0u;
            }
        }
        while opaque != 0u {
            let i = first + firstTrailingBit(opaque);
            opaque &= opaque - 1u;
            let touched = project_one(i);
            tiles[i] = touched;
            visible[i] = u32(touched > 0u);
        }
    }
#else
    for (var i = begin; i < total; i += groups.x * 64u) {
        let touched = project_one(i);
        tiles[i] = touched;
        visible[i] = u32(touched > 0u);
    }
#endif
}
