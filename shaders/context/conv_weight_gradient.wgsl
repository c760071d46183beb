// The gradient of `conv_down` or `conv_up` by weights and bias. `conv_down` has its gradient on the coarse side and its input
// on the fine side, `conv_up` the reverse. One parameter an invocation, summed over all texels in order.

#import tcgs::index::lane_index

struct Shape {
    // channels of the fine side, of the coarse side, edge of the coarse side, 1 if the bias is the fine side's
    shape: vec4u,
    // first value of the fine side, first value of the coarse side, first weight, first bias
    first: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
@group(0) @binding(1) var<storage, read> fine_side: array<f32>;
@group(0) @binding(2) var<storage, read> coarse_side: array<f32>;
@group(0) @binding(3) var<storage, read_write> gradients: array<f32>;

fn weight_gradient(weight: u32) -> f32 {
    let fine = shape.shape.x;
    let coarse = shape.shape.y;
    let edge = shape.shape.z;
    let pair = weight / 9u;
    let tap = weight - 9u * pair;
    let v = tap / 3u;
    let u = tap - 3u * v;
    let c = pair / fine;
    let f = pair - c * fine;
    var sum = 0.0;
    for (var plane = 0u; plane < 3u; plane++) {
        let coarse_first = shape.first.y + (plane * coarse + c) * edge * edge;
        let fine_first = shape.first.x + (plane * fine + f) * 4u * edge * edge;
        // The first row or column of taps reaches into the padding from place 0.
        for (var y = select(0u, 1u, v == 0u); y < edge; y++) {
            for (var x = select(0u, 1u, u == 0u); x < edge; x++) {
                let place = (2u * y + v - 1u) * 2u * edge + 2u * x + u - 1u;
                sum += coarse_side[coarse_first + y * edge + x] * fine_side[fine_first + place];
            }
        }
    }
    return sum;
}

fn bias_gradient(channel: u32) -> f32 {
    let edge = shape.shape.z;
    var sum = 0.0;
    for (var plane = 0u; plane < 3u; plane++) {
        if shape.shape.w == 1u {
            let area = 4u * edge * edge;
            let first = shape.first.x + (plane * shape.shape.x + channel) * area;
            for (var i = 0u; i < area; i++) {
                sum += fine_side[first + i];
            }
        } else {
            let area = edge * edge;
            let first = shape.first.y + (plane * shape.shape.y + channel) * area;
            for (var i = 0u; i < area; i++) {
                sum += coarse_side[first + i];
            }
        }
    }
    return sum;
}

@compute @workgroup_size(64)
fn conv_weight_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    let weights = 9u * shape.shape.x * shape.shape.y;
    if index < weights {
        gradients[shape.first.z + index] = weight_gradient(index);
        return;
    }
    let channel = index - weights;
    if channel < select(shape.shape.y, shape.shape.x, shape.shape.w == 1u) {
        gradients[shape.first.w + channel] = bias_gradient(channel);
    }
}
