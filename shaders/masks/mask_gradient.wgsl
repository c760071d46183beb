// Adds the rendering loss's gradient by the mask logits of the visible anchors (METHOD.md §4.1). The mask multiplies
// the opacity, so its gradient is the opacity's times the opacity; the binary mask passes it on straight-through, as the
// logistic of the logit would. A masked offset was not rendered and has none. Each anchor is visible at most once.
#import tcgs::model::{OFFSETS, logistic}
#import tcgs::permute::part_of

@group(0) @binding(0) var<storage, read> list: array<u32>;
@group(0) @binding(1) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(2) var<storage, read> d_geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read> logits: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_logits: array<f32>;

@compute @workgroup_size(64)
fn mask_gradient(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = part_of(group, groups) * 64u + local;
    if index >= list[0] {
        return;
    }
    let first = list[1u + index] * OFFSETS;
    for (var k = 0u; k < OFFSETS; k++) {
        let gaussian = index * OFFSETS + k;
        let opacity = geometry[gaussian].w;
        if !(opacity > 0.0) {
            continue;
        }
        let share = logistic(logits[first + k]);
        d_logits[first + k] += d_geometry[gaussian].w * opacity * share * (1.0 - share);
    }
}
