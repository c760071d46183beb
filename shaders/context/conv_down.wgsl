// A convolution of 3 x 3 taps, stride 2 and one texel of zero padding, over three planes at once: a fine tensor to a coarse
// one. Also the gradient of `conv_up` by its input. One output an invocation.
#import tcgs::convolution::{Convolution, ADD, GATE, NONE, RELU}
#import tcgs::index::lane_index

@group(0) @binding(0) var<uniform> convolution: Convolution;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
@group(0) @binding(2) var<storage, read> source: array<f32>;
@group(0) @binding(3) var<storage, read> gate: array<f32>;
@group(0) @binding(4) var<storage, read_write> results: array<f32>;

@compute @workgroup_size(64)
fn conv_down(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let fine = convolution.shape.x;
    let coarse = convolution.shape.y;
    let edge = convolution.shape.z;
    let index = lane_index(group, local);
    if index >= 3u * coarse * edge * edge {
        return;
    }
    let row = index / edge;
    let x = index - row * edge;
    let channel = row / edge;
    let y = row - channel * edge;
    let plane = channel / coarse;
    let output = channel - plane * coarse;
    var sum = 0.0;
    if convolution.first.y != NONE {
        sum = parameters[convolution.first.y + output];
    }
    for (var input = 0u; input < fine; input++) {
        let weights = convolution.first.x + (output * fine + input) * 9u;
        let values = convolution.first.z + (plane * fine + input) * 4u * edge * edge;
        for (var v = 0u; v < 3u; v++) {
            // One more than the row, so that it is never negative; the padding's is 0.
            let from_y = 2u * y + v;
            for (var u = 0u; u < 3u; u++) {
                let from_x = 2u * x + u;
                if from_y > 0u && from_x > 0u {
                    let value = source[values + (from_y - 1u) * 2u * edge + from_x - 1u];
                    sum += parameters[weights + 3u * v + u] * value;
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
