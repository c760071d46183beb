// Adds one view to the statistics that decide the growth of plain Gaussians: a row is the sum of screen-gradient norms,
// the count of views, and the largest radius on screen in pixels. Screen gradients are in half-image units: pixels
// times half the width and height. An overflowed pass adds nothing. With masks,
// a view that shows nothing of a Gaussian that counts, and so gives it no gradient, is none.
#import tcgs::index::lane_index
#import tcgs::plain::View

const ROW: u32 = 3u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> d_centers: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> statistics: array<f32>;
// Not 0 once a forward pass has overflowed: the step is repeated.
@group(0) @binding(3) var<storage, read> overflow_flag: array<u32>;

@compute @workgroup_size(64)
fn gaussian_statistics(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = lane_index(group, local);
    if i >= view.count || overflow_flag[0] != 0u {
        return;
    }
    // By the projected center, tiles touched, radius.
    let d = d_centers[i];
    if !(d.z > 0.0) {
        return;
    }
#ifdef MASKED
    if all(d.xy == vec2f(0.0)) {
        return;
    }
#endif
    let row = i * ROW;
    statistics[row] += length(d.xy * view.half_size);
    statistics[row + 1u] += 1.0;
    statistics[row + 2u] = max(statistics[row + 2u], d.w);
}
