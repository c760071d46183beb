// Adds the runs' partial sums of the weights and biases of all layers, as `dense_weight_gradient_software` lays them out, in run order.

#import tcgs::index::lane_index

struct Layer {
    // inputs, outputs, columns a run, end of the layer's vectors in a run
    shape: vec4u,
    // first weight, first bias, vectors of all layers in a run, unused
    places: vec4u,
}

@group(0) @binding(0) var<storage, read> layers: array<Layer>;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn sum_weight_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = lane_index(group, local);
    let all = layers[0].places.z;
    if at >= all {
        return;
    }
    let runs = (list[0] + layers[0].shape.z - 1u) / layers[0].shape.z;
    var sum = vec4f(0.0);
    for (var run = 0u; run < runs; run++) {
        sum += partials[run * all + at];
    }
    var first = 0u;
    for (var i = 0u; i < arrayLength(&layers); i++) {
        let layer = layers[i];
        let end = layer.shape.w;
        if at >= first && at < end {
            let inputs = layer.shape.x;
            let outputs = layer.shape.y;
            let row = (outputs + 3u) / 4u;
            let input = (at - first) / row;
            let output = 4u * (at - first - input * row);
            for (var k = 0u; k < 4u; k++) {
                if output + k < outputs {
                    if input < inputs {
                        sums[layer.places.x + output + k + input * outputs] = sum[k];
                    } else {
                        sums[layer.places.y + output + k] = sum[k];
                    }
                }
            }
        }
        first = end;
    }
}
