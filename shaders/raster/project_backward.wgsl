// Gradients of the visible Gaussians from those of their projections. On software adapters other rows are not written; elsewhere they
// become zero, and lanes take neighboring rows, since reads and writes by depth would be scattered.

#import tcgs::view::{VISIBLE, View, to_camera}
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
#ifdef SOFTWARE
@group(0) @binding(1) var<storage, read> counters: array<u32>;
#else
@group(0) @binding(1) var<storage, read> count: array<u32>;
#endif
@group(0) @binding(2) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
@group(0) @binding(4) var<storage, read> d_splats: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> d_geometry: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> d_colors: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> d_means_image: array<vec4f>;
#ifdef SOFTWARE
@group(0) @binding(8) var<storage, read> ids: array<u32>;
#endif

fn project_one_backward(i: u32) {
    let opacity = geometry[i].w;
    let scale = geometry[scale_row(view.gaussian_capacity, i)].xyz;
    let raw = geometry[quat_row(view.gaussian_capacity, i)];
    let d_place = d_splats[3u * i];
    let d_conic = d_splats[3u * i + 1u].xyz;
    let d_color = d_splats[3u * i + 2u];

    // Recomputes the projection of the forward kernel.
    let t = to_camera(view, geometry[i].xyz);
    let inverse_norm = inverseSqrt(dot(raw, raw));
    let q = raw * inverse_norm;
    let w = q.x;
    let v = q.yzw;
    let rx = vec3f(1.0 - 2.0 * (v.y * v.y + v.z * v.z), 2.0 * (v.x * v.y + w * v.z), 2.0 * (v.x * v.z - w * v.y));
    let ry = vec3f(2.0 * (v.x * v.y - w * v.z), 1.0 - 2.0 * (v.x * v.x + v.z * v.z), 2.0 * (v.y * v.z + w * v.x));
    let rr = vec3f(2.0 * (v.x * v.z + w * v.y), 2.0 * (v.y * v.z - w * v.x), 1.0 - 2.0 * (v.x * v.x + v.y * v.y));
    let rz = 1.0 / t.z;
    let slope = clamp(t.xy * rz, view.slope_low, view.slope_high);
    let free = slope == t.xy * rz;
    let row_u = view.focal.x * rz * (view.right.xyz - slope.x * view.forward.xyz);
    let row_v = view.focal.y * rz * (view.down.xyz - slope.y * view.forward.xyz);
    let nu = scale * vec3f(dot(row_u, rx), dot(row_u, ry), dot(row_u, rr));
    let nv = scale * vec3f(dot(row_v, rx), dot(row_v, ry), dot(row_v, rr));
    let normal = cross(nu, nv);
    let sharp = dot(normal, normal);
    let a = dot(nu, nu) + view.low_pass;
    let b = dot(nu, nv);
    let c = dot(nv, nv) + view.low_pass;
    let determinant = sharp + view.low_pass * (dot(nu, nu) + dot(nv, nv) + view.low_pass);
    let conic = vec3f(c, -b, a) / determinant;

    // Covariance: dC = -K dK K, with the off-diagonal gradient counted once.
    let half_y = 0.5 * d_conic.y;
    let p = conic.x * d_conic.x + conic.y * half_y;
    let r = conic.x * half_y + conic.y * d_conic.z;
    let s = conic.y * d_conic.x + conic.z * half_y;
    let u = conic.y * half_y + conic.z * d_conic.z;
    var d_a = -(p * conic.x + r * conic.y);
    var d_b = -2.0 * (p * conic.y + r * conic.z);
    var d_c = -(s * conic.y + u * conic.z);
    var d_opacity = d_place.z;
    if view.antialiased != 0u {
        let ratio = sharp / determinant;
        let compensation = sqrt(max(0.005 * 0.005, ratio));
        d_opacity = d_place.z * compensation;
        if ratio > 0.005 * 0.005 {
            let d_ratio = d_place.z * opacity / (2.0 * compensation);
            d_a += d_ratio * ((1.0 - ratio) * conic.x - view.low_pass / determinant);
            d_b += d_ratio * 2.0 * (1.0 - ratio) * conic.y;
            d_c += d_ratio * ((1.0 - ratio) * conic.z - view.low_pass / determinant);
        }
    }

    // C = N N^T, N = [row_u; row_v] R diag(scale).
    let d_nu = 2.0 * d_a * nu + d_b * nv;
    let d_nv = 2.0 * d_c * nv + d_b * nu;
    let d_ax = d_nu.x * row_u + d_nv.x * row_v;
    let d_ay = d_nu.y * row_u + d_nv.y * row_v;
    let d_az = d_nu.z * row_u + d_nv.z * row_v;
    let d_scale = vec3f(dot(rx, d_ax), dot(ry, d_ay), dot(rr, d_az));
    let dx = scale.x * d_ax;
    let dy = scale.y * d_ay;
    let dz = scale.z * d_az;
    let twist = vec3f(dy.z - dz.y, dz.x - dx.z, dx.y - dy.x);
    let d_q = 2.0 * vec4f(
        dot(v, twist),
        v.y * (dx.y + dy.x) + v.z * (dz.x + dx.z) + w * twist.x - 2.0 * v.x * (dy.y + dz.z),
        v.x * (dx.y + dy.x) + w * twist.y + v.z * (dy.z + dz.y) - 2.0 * v.y * (dx.x + dz.z),
        w * twist.z + v.x * (dz.x + dx.z) + v.y * (dy.z + dz.y) - 2.0 * v.z * (dx.x + dy.y),
    );
    let d_raw = (d_q - q * dot(q, d_q)) * inverse_norm;

    // Rows: row_u = (f/z) (right - slope forward), and the projected center.
    let d_row_u = d_nu.x * scale.x * rx + d_nu.y * scale.y * ry + d_nu.z * scale.z * rr;
    let d_row_v = d_nv.x * scale.x * rx + d_nv.y * scale.y * ry + d_nv.z * scale.z * rr;
    let along = vec2f(dot(d_row_u, view.right.xyz), dot(d_row_v, view.down.xyz));
    let depth = vec2f(dot(d_row_u, view.forward.xyz), dot(d_row_v, view.forward.xyz));
    let scale_z = view.focal * rz * rz;
    let d_center = d_place.xy;
    let d_xy = view.focal * rz * d_center - select(vec2f(0.0), scale_z * depth, free);
    let curve = select(vec2f(1.0), vec2f(2.0), free) * slope * depth;
    let d_z = dot(scale_z, curve - along - t.xy * d_center);
    let d_mean = d_xy.x * view.right.xyz + d_xy.y * view.down.xyz + d_z * view.forward.xyz;

    d_geometry[i] = vec4f(d_mean, d_opacity);
    d_geometry[scale_row(view.gaussian_capacity, i)] = vec4f(d_scale, 0.0);
    d_geometry[quat_row(view.gaussian_capacity, i)] = d_raw;
    d_colors[i] = d_color;
    // Three standard deviations along the longer axis.
    let middle = 0.5 * (a + c);
    let radius = 3.0 * sqrt(middle + sqrt(max(0.0, middle * middle - determinant)));
    d_means_image[i] = vec4f(d_center, f32(tiles[i]), radius);
}

@compute @workgroup_size(64)
fn project_backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
#ifdef SOFTWARE
    let total = min(counters[VISIBLE], view.gaussian_capacity);
    for (var place = begin; place < total; place += groups.x * 64u) {
        project_one_backward(ids[place]);
    }
#else
    let total = min(count[0], view.gaussian_capacity);
    for (var i = begin; i < total; i += groups.x * 64u) {
        if tiles[i] > 0u {
            project_one_backward(i);
        } else {
            d_geometry[i] = vec4f(0.0);
            d_geometry[scale_row(view.gaussian_capacity, i)] = vec4f(0.0);
            d_geometry[quat_row(view.gaussian_capacity, i)] = vec4f(0.0);
            d_colors[i] = vec4f(0.0);
            d_means_image[i] = vec4f(0.0);
        }
    }
#endif
}
