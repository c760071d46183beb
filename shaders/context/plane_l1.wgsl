// Adds the gradients of the weighted mean absolute difference of planes and their reconstruction, to both
// (TC-GS (5), METHOD.md §4.6). One value an invocation.

#import tcgs::index::lane_index

struct Shape {
    // values, first value of the planes and of their gradients, bits of the weight over the values, unused
    shape: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read> reconstruction: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_planes: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_reconstruction: array<f32>;

@compute @workgroup_size(64)
fn plane_l1(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    if index >= shape.shape.x {
        return;
    }
    let at = shape.shape.y + index;
    let share = bitcast<f32>(shape.shape.z) * sign(planes[at] - reconstruction[index]);
    d_planes[at] += share;
    d_reconstruction[index] -= share;
}
