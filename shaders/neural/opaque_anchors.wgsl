// Flags the visible anchors that make a Gaussian: those with an opaque offset whose mask is on. The others need no more of the
// networks. Until `spawn_gaussians` writes the Gaussians, no visible anchor has any.
#import tcgs::anchor_view::View
#import tcgs::finite::finite
#import tcgs::model::OFFSETS
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> outputs: array<f32>;
@group(0) @binding(3) var<storage, read> masks: array<u32>;
@group(0) @binding(4) var<storage, read_write> flags: array<u32>;
@group(0) @binding(5) var<storage, read_write> geometry: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> alive: array<u32>;

@compute @workgroup_size(64)
fn opaque_anchors(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = part_of(group, groups) * 64u + local;
    if index >= view.counts.x {
        return;
    }
    if index >= list[0] {
        flags[index] = 0u;
        return;
    }
    var opaque = 0u;
    for (var k = 0u; k < OFFSETS; k++) {
        let output = outputs[k * view.counts.y + index];
        if finite(output) && output > 0.0 {
            opaque |= 1u << k;
        }
        geometry[index * OFFSETS + k] = vec4f(0.0);
    }
    flags[index] = u32((opaque & masks[list[1u + index]]) != 0u);
    alive[index] = 0u;
}
