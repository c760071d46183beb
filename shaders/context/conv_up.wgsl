// A transposed convolution of 3 x 3 taps and stride 2 over three planes at once: a coarse value at (x, y) adds its weight
// (v, u) times itself to the fine value at (2 x + u - 1, 2 y + v - 1), where there is one. Also the gradient of
// `conv_down` by its input. One output an invocation, which gathers what reaches it.
#import tcgs::convolution::{Convolution, ADD, GATE, NONE, RELU}
#import tcgs::index::lane_index

@group(0) @binding(0) var<uniform> convolution: Convolution;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
@group(0) @binding(2) var<storage, read> source: array<f32>;
@group(0) @binding(3) var<storage, read> gate: array<f32>;
@group(0) @binding(4) var<storage, read_write> results: array<f32>;

@compute @workgroup_size(64)
fn conv_up(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let fine = convolution.shape.x;
    let coarse = convolution.shape.y;
    let edge = convolution.shape.z;
    let index = lane_index(group, local);
    if index >= 12u * fine * edge * edge {
        return;
    }
    let row = index / (2u * edge);
    let x = index - row * 2u * edge;
    let channel = row / (2u * edge);
    let y = row - channel * 2u * edge;
    let plane = channel / fine;
    let output = channel - plane * fine;
    var sum = 0.0;
    if convolution.first.y != NONE {
        sum = parameters[convolution.first.y + output];
    }
    // An even place is reached by the tap in the middle alone, an odd one by the two others.
    let first_u = 1u - (x & 1u);
    let first_v = 1u - (y & 1u);
    for (var input = 0u; input < coarse; input++) {
        let weights = convolution.first.x + (input * fine + output) * 9u;
        let values = convolution.first.z + (plane * coarse + input) * edge * edge;
        for (var v = first_v; v < 3u; v += 2u) {
            let from_y = (y + 1u - v) / 2u;
            for (var u = first_u; u < 3u; u += 2u) {
                let from_x = (x + 1u - u) / 2u;
                if from_y < edge && from_x < edge {
                    sum += parameters[weights + 3u * v + u] * source[values + from_y * edge + from_x];
                }
            }
        }
    }
    let at = convolution.first.w + index;
    if convolution.activation.x == RELU {
        sum = max(sum, 0.0);
    }
    if convolution.activation.x == GATE {
        sum = select(0.0, sum, gate[convolution.activation.y + index] > 0.0);
    }
    if convolution.activation.x == ADD {
        sum += results[at];
    }
    results[at] = sum;
}
