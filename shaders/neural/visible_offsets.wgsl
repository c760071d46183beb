// Adds the offsets that a view can show to those that other views do: bit k of an anchor's word is its offset k. An offset can
// show if its opacity reaches a pixel, its mask is on, and position and size are finite, as in `spawn_gaussians`.
#import tcgs::anchor_view::View
#import tcgs::finite::{below, each_below, finite}
#import tcgs::model::{ROW, OFFSETS, SCALING_COLUMN, OFFSET_COLUMN, LIMIT, tanh_bounded}
#import tcgs::permute::part_of

// The rasterizer skips smaller opacities (METHOD.md §3.2).
const MIN_OPACITY: f32 = 1.0 / 255.0;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> positions: array<vec4f>;
@group(0) @binding(3) var<storage, read> rows: array<f32>;
@group(0) @binding(4) var<storage, read> outputs: array<f32>;
@group(0) @binding(5) var<storage, read> masks: array<u32>;
@group(0) @binding(6) var<storage, read_write> shown: array<u32>;

@compute @workgroup_size(64)
fn visible_offsets(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = part_of(group, groups) * 64u + local;
    if index >= list[0] {
        return;
    }
    let anchor = list[1u + index];
    let row = anchor * ROW;
    let position = positions[anchor].xyz - view.center.xyz;
    let s = row + SCALING_COLUMN;
    let reach = exp(vec3f(rows[s], rows[s + 1u], rows[s + 2u]));
    let size = exp(vec3f(rows[s + 3u], rows[s + 4u], rows[s + 5u]));
    if !below(size.x * size.y * size.z, LIMIT) {
        return;
    }
    var found = 0u;
    for (var k = 0u; k < OFFSETS; k++) {
        let output = outputs[k * view.counts.y + index];
        let o = row + OFFSET_COLUMN + 3u * k;
        let mean = position + vec3f(rows[o], rows[o + 1u], rows[o + 2u]) * reach;
        if finite(output) && tanh_bounded(output) >= MIN_OPACITY && all(each_below(vec4f(mean, 0.0), LIMIT)) {
            found |= 1u << k;
        }
    }
    shown[anchor] |= found & masks[anchor];
}
