// Gathers the networks' input of each visible anchor, or of each opaque one among them: feature, unit view direction,
// distance in the scene's unit (METHOD.md §2.2; in the published code always the world's).
// Column-major: input[row * capacity + column]. A feature value that is not finite reads as zero: it would make
// the gradients of the weights that all anchors share NaN.
#import tcgs::anchor_view::{View, ray_to}
#import tcgs::finite::below
#import tcgs::model::{FEATURES, LIMIT, ROW}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> positions: array<vec4f>;
@group(0) @binding(3) var<storage, read> rows: array<f32>;
@group(0) @binding(4) var<storage, read_write> input: array<f32>;
#ifdef OPAQUE
// The number of columns, the place of each column's anchor in the list, and from 1 + capacity on the anchors, written here.
@group(0) @binding(5) var<storage, read_write> columns: array<u32>;
#endif

@compute @workgroup_size(64)
fn network_input(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = part_of(group, groups) * 64u + local;
    let capacity = view.counts.y;
#ifdef OPAQUE
    if index >= columns[0] {
        return;
    }
    let anchor = list[1u + columns[1u + index]];
    columns[1u + capacity + index] = anchor;
#else
    if index >= list[0] {
        return;
    }
    let anchor = list[1u + index];
#endif
    for (var feature = 0u; feature < FEATURES; feature++) {
        let value = rows[anchor * ROW + feature];
        input[feature * capacity + index] = select(0.0, value, below(value, LIMIT));
    }
    let ray = ray_to(view, positions[anchor].xyz);
    let distance = max(length(ray), 1e-12);
    let direction = ray / distance;
    input[FEATURES * capacity + index] = direction.x;
    input[(FEATURES + 1u) * capacity + index] = direction.y;
    input[(FEATURES + 2u) * capacity + index] = direction.z;
    input[(FEATURES + 3u) * capacity + index] = distance * view.center.w;
}
