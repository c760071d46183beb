// A dense layer over the visible anchors, or its transpose: results[o][i] = sum over k of W(o, k) source[k][i], then bias and
// ReLU, or the gate of a ReLU (for the gradient with respect to a hidden layer). Column-major data; the weight of
// (o, k) is parameters[weights + o * out_stride + k * in_stride]. MODE is 0 for no activation, 1 for ReLU, 2 for the gate.
//
// An invocation computes eight outputs of one column: a scene of a few thousand anchors then still occupies a GPU. The workgroup
// reads the weights once for all of its columns.

#import tcgs::index::group_index

struct Layer {
    // inputs, outputs, capacity, weights
    shape: vec4u,
    // out_stride, in_stride, bias (or NONE), unused
    access: vec4u,
    // first row in the input, first row in the output, first row in the gate, unused
    rows: vec4u,
}

const NONE: u32 = 0xffffffffu;
const LANES: u32 = 64u;
const OUTPUTS: u32 = 8u;
// Inputs whose weights the workgroup holds at a time, a multiple of four.
const INPUTS: u32 = 64u;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> parameters: array<f32>;
@group(0) @binding(3) var<storage, read> source: array<f32>;
@group(0) @binding(4) var<storage, read_write> results: array<f32>;
#if MODE == 2
@group(0) @binding(5) var<storage, read> gate: array<f32>;
#endif

// Of each input, the weights of eight outputs: zero beyond the last input.
var<workgroup> weights: array<vec4f, 2u * INPUTS>;

fn weight_at(output: u32, input: u32) -> f32 {
    let o = min(output, layer.shape.y - 1u);
    return parameters[layer.shape.w + o * layer.access.x + input * layer.access.y];
}

fn four_weights(output: u32, input: u32) -> vec4f {
    let i = min(input, layer.shape.x - 1u);
    let four = vec4f(weight_at(output, i), weight_at(output + 1u, i), weight_at(output + 2u, i), weight_at(output + 3u, i));
    return select(vec4f(0.0), four, input < layer.shape.x);
}

fn value_at(column: u32, input: u32) -> f32 {
    return source[(layer.rows.x + min(input, layer.shape.x - 1u)) * layer.shape.z + column];
}

fn finish(output: u32, column: u32, sum: f32) {
    if output < layer.shape.y {
        let capacity = layer.shape.z;
        var value = sum;
        if layer.access.z != NONE {
            value += parameters[layer.access.z + output];
        }
#if MODE == 1
        value = max(value, 0.0);
#endif
#if MODE == 2
        if !(gate[(layer.rows.z + output) * capacity + column] > 0.0) {
            value = 0.0;
        }
#endif
        results[(layer.rows.y + output) * capacity + column] = value;
    }
}

fn finish_four(output: u32, column: u32, sums: vec4f) {
    finish(output, column, sums.x);
    finish(output + 1u, column, sums.y);
    finish(output + 2u, column, sums.z);
    finish(output + 3u, column, sums.w);
}

@compute @workgroup_size(LANES)
fn dense(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let tiles = (layer.shape.y + OUTPUTS - 1u) / OUTPUTS;
    let block = group_index(group);
    let strip = block / tiles;
    let first = (block - strip * tiles) * OUTPUTS;
    let count = list[0];
    // Uniform: either all invocations of a workgroup return here or none.
    if strip * LANES >= count {
        return;
    }
    let column = strip * LANES + local;
    let read = min(column, count - 1u);
    let inputs = layer.shape.x;
    var low = vec4f(0.0);
    var high = vec4f(0.0);
    for (var base = 0u; base < inputs; base += INPUTS) {
        workgroupBarrier();
        for (var i = local; i < 2u * INPUTS; i += LANES) {
            weights[i] = four_weights(first + 4u * (i & 1u), base + i / 2u);
        }
        workgroupBarrier();
        let here = min(INPUTS, inputs - base);
        // Weights beyond the last input are zero.
        for (var k = 0u; k < here; k += 4u) {
            let x = vec4f(
                value_at(read, base + k),
                value_at(read, base + k + 1u),
                value_at(read, base + k + 2u),
                value_at(read, base + k + 3u),
            );
            low += x.x * weights[2u * k];
            high += x.x * weights[2u * k + 1u];
            low += x.y * weights[2u * k + 2u];
            high += x.y * weights[2u * k + 3u];
            low += x.z * weights[2u * k + 4u];
            high += x.z * weights[2u * k + 5u];
            low += x.w * weights[2u * k + 6u];
            high += x.w * weights[2u * k + 7u];
        }
    }
    if column < count {
        finish_four(first, column, low);
        finish_four(first + 4u, column, high);
    }
}
