// Turns the loss's gradient by the corrected colors into the one by the render's, in place, and sums the gradient by the correction's
// rows over the pixels of a workgroup, in a fixed order (METHOD.md §2.11). A pixel that does not count has no gradient and adds none.
#import tcgs::index::group_index

const LANES: u32 = 64u;
// Pixels of a lane.
const RUN: u32 = 16u;

@group(0) @binding(0) var<uniform> pixels_and_photograph: vec4u;
@group(0) @binding(1) var<storage, read> rows: array<vec4f>;
@group(0) @binding(2) var<storage, read> render: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> d_image: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> partial_sums: array<vec4f>;

var<workgroup> lane_sums: array<mat3x4f, LANES>;

@compute @workgroup_size(LANES)
fn correct_colors_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = group_index(group);
    let row = 3u * pixels_and_photograph.y;
    let correction = mat3x4f(rows[row], rows[row + 1u], rows[row + 2u]);
    var sum = mat3x4f();
    for (var k = 0u; k < RUN; k++) {
        let pixel = (index * RUN + k) * LANES + local;
        if pixel >= pixels_and_photograph.x {
            break;
        }
        let d = d_image[pixel];
        let color = vec4f(render[pixel].xyz, 1.0);
        sum += mat3x4f(d.x * color, d.y * color, d.z * color);
        d_image[pixel] = vec4f((correction * d.xyz).xyz, d.w);
    }
    lane_sums[local] = sum;
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if local < reach {
            lane_sums[local] += lane_sums[local + reach];
        }
        workgroupBarrier();
    }
    // A dispatch of many workgroups has some that have no pixel.
    if local < 3u && index * RUN * LANES < pixels_and_photograph.x {
        partial_sums[3u * index + local] = lane_sums[0][local];
    }
}
