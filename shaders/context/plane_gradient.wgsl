// The gradient by every value of the planes: the gradients by the samples near its texel, weighted as they were sampled, in
// the order of the texel's list. Without atomics, so the same input gives the same bits. An invocation sums four
// channels of one texel.

#import tcgs::index::lane_index

struct Shape {
    // edge of a plane, fours of channels, first result, unused
    shape: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
// Where each texel's list begins, plane by plane, and where the last one ends.
@group(0) @binding(1) var<storage, read> starts: array<u32>;
// An anchor and the bits of its weight.
@group(0) @binding(2) var<storage, read> users: array<vec2u>;
// Rows of anchors, plane by plane.
@group(0) @binding(3) var<storage, read> d_samples: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> results: array<f32>;

@compute @workgroup_size(64)
fn plane_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let area = shape.shape.x * shape.shape.x;
    let fours = shape.shape.y;
    let index = lane_index(group, local);
    if index >= 3u * fours * area {
        return;
    }
    let four = index / (3u * area);
    let texel = index - four * 3u * area;
    let plane = texel / area;
    let end = starts[texel + 1u];
    var sum = vec4f(0.0);
    for (var entry = starts[texel]; entry < end; entry++) {
        let user = users[entry];
        sum += bitcast<f32>(user.y) * d_samples[(user.x * 3u + plane) * fours + four];
    }
    let at = shape.shape.z + (plane * fours + four) * 4u * area + texel - plane * area;
    results[at] = sum.x;
    results[at + area] = sum.y;
    results[at + 2u * area] = sum.z;
    results[at + 3u * area] = sum.w;
}
