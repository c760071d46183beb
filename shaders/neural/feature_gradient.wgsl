// Scatters the gradient of the networks' input to the opaque anchors' features; each anchor has at most one column.
#import tcgs::anchor_view::View
#import tcgs::model::{FEATURES, ROW}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> columns: array<u32>;
@group(0) @binding(2) var<storage, read> d_input: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_rows: array<f32>;

@compute @workgroup_size(64)
fn feature_gradient(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let column = part_of(group, groups) * 64u + local;
    if column >= columns[0] {
        return;
    }
    let anchor = columns[1u + view.counts.y + column];
    for (var feature = 0u; feature < FEATURES; feature++) {
        d_rows[anchor * ROW + feature] = d_input[feature * view.counts.y + column];
    }
}
