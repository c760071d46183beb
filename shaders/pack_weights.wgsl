// The weights of a layer for `dense_software`: of each output all inputs, in vectors of four, zero past the last.

struct Layer {
    // inputs, outputs, first weight, vectors an output
    shape: vec4u,
    // distance of weights from one output to the next, from one input to the next, unused, unused
    strides: vec4u,
}

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
@group(0) @binding(2) var<storage, read_write> packed: array<vec4f>;

fn weight(output: u32, input: u32) -> f32 {
    let at = layer.shape.z + output * layer.strides.x + min(input, layer.shape.x - 1u) * layer.strides.y;
    return select(0.0, parameters[at], input < layer.shape.x);
}

@compute @workgroup_size(64)
fn pack_weights(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.x + group.y * 65535u) * 64u + local;
    let output = at / layer.shape.w;
    if output >= layer.shape.y {
        return;
    }
    let input = 4u * (at - output * layer.shape.w);
    packed[at] = vec4f(
        weight(output, input),
        weight(output, input + 1u),
        weight(output, input + 2u),
        weight(output, input + 3u),
    );
}
