// A dense layer over the visible anchors, or its transpose: results[o][i] = sum over k of W(o, k) source[k][i], then bias and
// ReLU, or the gate of a ReLU (for the gradient with respect to a hidden layer). Column-major data; the weight of
// (o, k) is parameters[weights + o * out_stride + k * in_stride].
//
// An invocation computes 16 outputs of two columns. With subgroups, each lane reads one weight and the lanes
// share them by broadcast: a uniform read inside a loop costs a software adapter one read for every lane.

struct Layer {
    // inputs, outputs, capacity, weights
    shape: vec4u,
    // out_stride, in_stride, bias (or NONE), mode: 0 linear, 1 ReLU, 2 gate
    access: vec4u,
    // first row in the input, first row in the output, first row in the gate, add to the output if not 0
    rows: vec4u,
}

const NONE: u32 = 0xffffffffu;
const LANES: u32 = 64u;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> parameters: array<f32>;
@group(0) @binding(3) var<storage, read> source: array<f32>;
@group(0) @binding(4) var<storage, read> gate: array<f32>;
@group(0) @binding(5) var<storage, read_write> results: array<f32>;

fn weight_at(output: u32, input: u32) -> f32 {
    let o = min(output, layer.shape.y - 1u);
    return parameters[layer.shape.w + o * layer.access.x + input * layer.access.y];
}

fn finish(output: u32, column: u32, count: u32, sum: f32) {
    if output >= layer.shape.y || column >= count {
        return;
    }
    let capacity = layer.shape.z;
    var value = sum;
    if layer.access.z != NONE {
        value += parameters[layer.access.z + output];
    }
    let at = (layer.rows.y + output) * capacity + column;
    if layer.access.w == 1u {
        value = max(value, 0.0);
    }
    if layer.access.w == 2u && gate[(layer.rows.z + output) * capacity + column] <= 0.0 {
        value = 0.0;
    }
    if layer.rows.w != 0u {
        value += results[at];
    }
    results[at] = value;
}

@compute @workgroup_size(LANES)
fn dense(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) local: u32,
#ifdef SUBGROUPS
    @builtin(subgroup_invocation_id) lane: u32,
#endif
) {
    let tiles = (layer.shape.y + 15u) / 16u;
    let block = group.x + group.y * 65535u;
    let first = (block % tiles) * 16u;
    let count = list[0];
    let column = (block / tiles) * 2u * LANES + local;
    // Every invocation of a workgroup leaves here or none does.
    if (block / tiles) * 2u * LANES >= count {
        return;
    }
    let capacity = layer.shape.z;
    let a = min(column, count - 1u);
    let b = min(column + LANES, count - 1u);
    var s0 = vec2f(0.0);
    var s1 = vec2f(0.0);
    var s2 = vec2f(0.0);
    var s3 = vec2f(0.0);
    var s4 = vec2f(0.0);
    var s5 = vec2f(0.0);
    var s6 = vec2f(0.0);
    var s7 = vec2f(0.0);
    var s8 = vec2f(0.0);
    var s9 = vec2f(0.0);
    var s10 = vec2f(0.0);
    var s11 = vec2f(0.0);
    var s12 = vec2f(0.0);
    var s13 = vec2f(0.0);
    var s14 = vec2f(0.0);
    var s15 = vec2f(0.0);
    for (var k = 0u; k < layer.shape.x; k++) {
        let source_row = (layer.rows.x + k) * capacity;
        let x = vec2f(source[source_row + a], source[source_row + b]);
#ifdef SUBGROUPS
        let low = weight_at(first + (lane & 7u), k);
        let high = weight_at(first + 8u + (lane & 7u), k);
        s0 += subgroupBroadcast(low, 0u) * x;
        s1 += subgroupBroadcast(low, 1u) * x;
        s2 += subgroupBroadcast(low, 2u) * x;
        s3 += subgroupBroadcast(low, 3u) * x;
        s4 += subgroupBroadcast(low, 4u) * x;
        s5 += subgroupBroadcast(low, 5u) * x;
        s6 += subgroupBroadcast(low, 6u) * x;
        s7 += subgroupBroadcast(low, 7u) * x;
        s8 += subgroupBroadcast(high, 0u) * x;
        s9 += subgroupBroadcast(high, 1u) * x;
        s10 += subgroupBroadcast(high, 2u) * x;
        s11 += subgroupBroadcast(high, 3u) * x;
        s12 += subgroupBroadcast(high, 4u) * x;
        s13 += subgroupBroadcast(high, 5u) * x;
        s14 += subgroupBroadcast(high, 6u) * x;
        s15 += subgroupBroadcast(high, 7u) * x;
#else
        s0 += weight_at(first, k) * x;
        s1 += weight_at(first + 1u, k) * x;
        s2 += weight_at(first + 2u, k) * x;
        s3 += weight_at(first + 3u, k) * x;
        s4 += weight_at(first + 4u, k) * x;
        s5 += weight_at(first + 5u, k) * x;
        s6 += weight_at(first + 6u, k) * x;
        s7 += weight_at(first + 7u, k) * x;
        s8 += weight_at(first + 8u, k) * x;
        s9 += weight_at(first + 9u, k) * x;
        s10 += weight_at(first + 10u, k) * x;
        s11 += weight_at(first + 11u, k) * x;
        s12 += weight_at(first + 12u, k) * x;
        s13 += weight_at(first + 13u, k) * x;
        s14 += weight_at(first + 14u, k) * x;
        s15 += weight_at(first + 15u, k) * x;
#endif
    }
    var sums = array<vec2f, 16>(s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12, s13, s14, s15);
    for (var output = 0u; output < 16u; output++) {
        finish(first + output, column, count, sums[output].x);
        finish(first + output, column + LANES, count, sums[output].y);
    }
}
