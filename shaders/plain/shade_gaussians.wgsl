// Plain Gaussians from their parameters: exponential of the log-scales, logistic of the opacity, and the color of the
// spherical harmonics towards the camera, at least zero. Gaussians behind the near plane or too transparent to reach a pixel
// get opacity zero, and their coefficients are not read.
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::harmonics::{SH_ZERO, basis_of_one, basis_of_two, basis_of_three}
#import tcgs::index::lane_index
#import tcgs::plain::{View, BASE, LOG_SCALE, QUAT, OPACITY, COLOR, DEGREE, ALPHA_MIN, bands_at, ray_to, to_camera}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> base: array<f32>;
@group(0) @binding(2) var<storage, read> bands: array<f32>;
@group(0) @binding(3) var<storage, read_write> geometry: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> colors: array<vec4f>;

fn coefficient(at: u32) -> vec3f {
    return vec3f(bands[at], bands[at + 1u], bands[at + 2u]);
}

@compute @workgroup_size(64)
fn shade_gaussians(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = lane_index(group, local);
    if i >= view.count {
        return;
    }
    let row = i * BASE;
    let mean = vec3f(base[row], base[row + 1u], base[row + 2u]);
    let opacity = 1.0 / (1.0 + exp(-base[row + OPACITY]));
    if !(to_camera(view, mean).z > view.eye.w && opacity >= ALPHA_MIN) {
        geometry[i] = vec4f(0.0);
        return;
    }
    let s = row + LOG_SCALE;
    let q = row + QUAT;
    let c = row + COLOR;
    geometry[i] = vec4f(mean, opacity);
    geometry[scale_row(view.count, i)] = vec4f(exp(vec3f(base[s], base[s + 1u], base[s + 2u])), 0.0);
    geometry[quat_row(view.count, i)] = vec4f(base[q], base[q + 1u], base[q + 2u], base[q + 3u]);
    var color = 0.5 + SH_ZERO * vec3f(base[c], base[c + 1u], base[c + 2u]);
    if DEGREE > 0u {
        let at = bands_at(view, i);
        let d = normalize(ray_to(view, mean));
        let b = basis_of_one(d);
        color += b.x * coefficient(at.x) + b.y * coefficient(at.x + 3u) + b.z * coefficient(at.x + 6u);
        if DEGREE > 1u {
            let b = basis_of_two(d);
            color += b[0] * coefficient(at.y) + b[1] * coefficient(at.y + 3u) + b[2] * coefficient(at.y + 6u)
                + b[3] * coefficient(at.y + 9u) + b[4] * coefficient(at.y + 12u);
        }
        if DEGREE > 2u {
            let b = basis_of_three(d);
            color += b[0] * coefficient(at.z) + b[1] * coefficient(at.z + 3u) + b[2] * coefficient(at.z + 6u)
                + b[3] * coefficient(at.z + 9u) + b[4] * coefficient(at.z + 12u) + b[5] * coefficient(at.z + 15u)
                + b[6] * coefficient(at.z + 18u);
        }
    }
    colors[i] = vec4f(max(color, vec3f(0.0)), 0.0);
}
