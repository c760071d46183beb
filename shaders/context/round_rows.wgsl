// The render networks as decoded from a file: each row's weights as multiples of the row's scale, the upper half of an f32,
// and each layer's biases as multiples of the layer's scale, a whole f32.

#import tcgs::index::lane_index

struct Shape {
    // rows, unused, unused, unused
    rows: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
// First parameter, distance to the next, how many, levels; biases have bit 31 of their levels set.
@group(0) @binding(1) var<storage, read> rows: array<vec4u>;
@group(0) @binding(2) var<storage, read> parameters: array<f32>;
@group(0) @binding(3) var<storage, read_write> rounded: array<f32>;

const IS_BIAS: u32 = 0x80000000u;

// Largest finite number in the upper half of an f32.
const LARGEST_HALF: u32 = 0x7f7fu;

@compute @workgroup_size(64)
fn round_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    if index >= shape.rows.x {
        return;
    }
    let row = rows[index];
    let levels = f32(row.w & ~IS_BIAS);
    var largest = 0.0;
    for (var i = 0u; i < row.z; i++) {
        largest = max(largest, abs(parameters[row.x + i * row.y]));
    }
    var scale = largest / levels;
    if (row.w & IS_BIAS) == 0u {
        // Rounded up, so that no weight exceeds its levels.
        scale = bitcast<f32>(min((bitcast<u32>(scale) + 0xffffu) >> 16u, LARGEST_HALF) << 16u);
    }
    for (var i = 0u; i < row.z; i++) {
        let at = row.x + i * row.y;
        var nearest = 0.0;
        if scale != 0.0 {
            nearest = clamp(round(parameters[at] / scale), -levels, levels) * scale;
        }
        rounded[at] = nearest;
    }
}
