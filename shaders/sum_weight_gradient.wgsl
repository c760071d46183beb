// Adds the runs' partial sums of a layer's weights and bias, as `dense_weight_gradient_software` lays them out, in run order.

struct Layer {
    // inputs, outputs, columns a run, unused
    shape: vec4u,
    // first weight, first bias (or NONE), distance of weights from one output to the next, from one input to the next
    places: vec4u,
}

const NONE: u32 = 0xffffffffu;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn sum_weight_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.x + group.y * 65535u) * 64u + local;
    let inputs = layer.shape.x;
    let outputs = layer.shape.y;
    let row = (outputs + 3u) / 4u;
    let input = at / row;
    if input > inputs {
        return;
    }
    let runs = (list[0] + layer.shape.z - 1u) / layer.shape.z;
    var sum = vec4f(0.0);
    for (var run = 0u; run < runs; run++) {
        sum += partials[run * (inputs + 1u) * row + at];
    }
    let output = 4u * (at - input * row);
    for (var i = 0u; i < 4u; i++) {
        if output + i < outputs {
            if input < inputs {
                sums[layer.places.x + (output + i) * layer.places.z + input * layer.places.w] = sum[i];
            } else {
                sums[layer.places.y + output + i] = sum[i];
            }
        }
    }
}
