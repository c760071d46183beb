// Gathers, for every anchor, the gradients by the plane samples at it, from all sampled anchors that have it as a neighbor,
// in the order of its list. Without atomics, so the same input gives the same bits.

#import tcgs::index::lane_index

struct Shape {
    // anchors, plane samples of an anchor, columns of a row, unused
    shape: vec4u,
}

// The column of an anchor that was not sampled.
const NONE: u32 = 0xffffffffu;

@group(0) @binding(0) var<uniform> shape: Shape;
// Where each anchor's list begins, and where the last one ends.
@group(0) @binding(1) var<storage, read> starts: array<u32>;
// Of each anchor that has it as a neighbor: four times its index, plus which neighbor.
@group(0) @binding(2) var<storage, read> users: array<u32>;
@group(0) @binding(3) var<storage, read> columns: array<u32>;
@group(0) @binding(4) var<storage, read> d_input: array<f32>;
// Rows of anchors.
@group(0) @binding(5) var<storage, read_write> d_samples: array<f32>;

@compute @workgroup_size(64)
fn neighbor_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let anchor = lane_index(group, local);
    if anchor >= shape.shape.x {
        return;
    }
    let width = shape.shape.y;
    let first = anchor * width;
    for (var i = 0u; i < width; i++) {
        d_samples[first + i] = 0.0;
    }
    let end = starts[anchor + 1u];
    for (var entry = starts[anchor]; entry < end; entry++) {
        let user = users[entry];
        let column = columns[user >> 2u];
        if column == NONE {
            continue;
        }
        let row = (user & 3u) * width;
        for (var i = 0u; i < width; i++) {
            d_samples[first + i] += d_input[(row + i) * shape.shape.z + column];
        }
    }
}
