// Adds one view to the statistics that decide growth and pruning (METHOD.md §2.6). An anchor's row of
// statistics: OFFSETS sums of screen-gradient norms, OFFSETS counts of views, a sum of positive opacities, visits.
// Screen gradients are in half-image units: pixels times half the width and height. An overflowed pass adds nothing.
// With masks, a view that shows nothing of a Gaussian that counts, and so gives it no gradient, is none.
#import tcgs::anchor_view::View
#import tcgs::model::OFFSETS
#import tcgs::permute::part_of

const ROW: u32 = 2u * OFFSETS + 2u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read> d_means2d: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> statistics: array<f32>;
// Not 0 once a forward pass has overflowed: the step is repeated.
@group(0) @binding(5) var<storage, read> overflow_flag: array<u32>;

fn shows(d: vec4f) -> bool {
#ifdef MASKED
    return any(d.xy != vec2f(0.0));
#else
    return true;
#endif
}

@compute @workgroup_size(64)
fn anchor_statistics(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = part_of(group, groups) * 64u + local;
    if index >= list[0] || overflow_flag[0] != 0u {
        return;
    }
    let row = list[1u + index] * ROW;
    var opacities = 0.0;
    for (var k = 0u; k < OFFSETS; k++) {
        let gaussian = index * OFFSETS + k;
        let opacity = geometry[gaussian].w;
        if !(opacity > 0.0) {
            continue;
        }
        opacities += opacity;
        let d = d_means2d[gaussian];
        if d.z > 0.0 && shows(d) {
            statistics[row + k] += length(d.xy * 0.5 * view.image.xy);
            statistics[row + OFFSETS + k] += 1.0;
        }
    }
    statistics[row + 2u * OFFSETS] += opacities;
    statistics[row + 2u * OFFSETS + 1u] += 1.0;
}
