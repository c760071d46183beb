// A dense layer over the visible anchors, or its transpose: results[o][i] = sum over k of W(o, k) source[k][i], then bias and
// ReLU, or the gate of a ReLU (for the gradient with respect to a hidden layer). Column-major data; the weight of
// (o, k) is parameters[weights + o * out_stride + k * in_stride].
//
// Reads dominate on a software adapter, eight lanes at a time. So an invocation computes 32 outputs of four columns, and with
// subgroups each lane reads one weight and the lanes share them by broadcast. Each iteration takes two inputs, because every
// assignment in a loop is masked. Sums are never indexed by a variable: that would keep them in memory, and for a layer of
// few inputs reading them back costs as much as the sums.

struct Layer {
    // inputs, outputs, capacity, weights
    shape: vec4u,
    // out_stride, in_stride, bias (or NONE), mode: 0 linear, 1 ReLU, 2 gate
    access: vec4u,
    // first row in the input, first row in the output, first row in the gate, unused
    rows: vec4u,
}

const NONE: u32 = 0xffffffffu;
const LANES: u32 = 64u;
const TILE: u32 = 32u;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> parameters: array<f32>;
@group(0) @binding(3) var<storage, read> source: array<f32>;
@group(0) @binding(4) var<storage, read> gate: array<f32>;
@group(0) @binding(5) var<storage, read_write> results: array<f32>;

// The weights of eight outputs.
struct Eight {
    low: vec4f,
    high: vec4f,
}

fn weight_at(output: u32, input: u32) -> f32 {
    let o = min(output, layer.shape.y - 1u);
    return parameters[layer.shape.w + o * layer.access.x + input * layer.access.y];
}

#ifdef SUBGROUPS
fn weights_at(output: u32, input: u32, lane: u32) -> Eight {
    let own = weight_at(output + (lane & 7u), input);
    return Eight(
        vec4f(
            subgroupBroadcast(own, 0u),
            subgroupBroadcast(own, 1u),
            subgroupBroadcast(own, 2u),
            subgroupBroadcast(own, 3u),
        ),
        vec4f(
            subgroupBroadcast(own, 4u),
            subgroupBroadcast(own, 5u),
            subgroupBroadcast(own, 6u),
            subgroupBroadcast(own, 7u),
        ),
    );
}
#else
fn weights_at(output: u32, input: u32, lane: u32) -> Eight {
    return Eight(
        vec4f(
            weight_at(output, input),
            weight_at(output + 1u, input),
            weight_at(output + 2u, input),
            weight_at(output + 3u, input),
        ),
        vec4f(
            weight_at(output + 4u, input),
            weight_at(output + 5u, input),
            weight_at(output + 6u, input),
            weight_at(output + 7u, input),
        ),
    );
}
#endif

// One matrix column an output.
fn outer(values: vec4f, weights: vec4f) -> mat4x4f {
    return mat4x4f(weights.x * values, weights.y * values, weights.z * values, weights.w * values);
}

fn values_at(columns: vec4u, input: u32) -> vec4f {
    let at = (layer.rows.x + input) * layer.shape.z + columns;
    return vec4f(source[at.x], source[at.y], source[at.z], source[at.w]);
}

fn put(at: u32, value: f32, column: u32, count: u32) {
    if column < count {
        results[at] = value;
    }
    return;
}

fn finish(output: u32, columns: vec4u, count: u32, sums: vec4f) {
    if output < layer.shape.y {
        let capacity = layer.shape.z;
        var values = sums;
        if layer.access.z != NONE {
            values += parameters[layer.access.z + output];
        }
        if layer.access.w == 1u {
            values = max(values, vec4f(0.0));
        }
        if layer.access.w == 2u {
            let at = (layer.rows.z + output) * capacity + min(columns, vec4u(capacity - 1u));
            values = select(vec4f(0.0), values, vec4f(gate[at.x], gate[at.y], gate[at.z], gate[at.w]) > vec4f(0.0));
        }
        let at = (layer.rows.y + output) * capacity + columns;
        put(at.x, values.x, columns.x, count);
        put(at.y, values.y, columns.y, count);
        put(at.z, values.z, columns.z, count);
        put(at.w, values.w, columns.w, count);
    }
    return;
}

fn finish_four(output: u32, columns: vec4u, count: u32, sums: mat4x4f) {
    finish(output, columns, count, sums[0]);
    finish(output + 1u, columns, count, sums[1]);
    finish(output + 2u, columns, count, sums[2]);
    finish(output + 3u, columns, count, sums[3]);
}

@compute @workgroup_size(LANES)
fn dense(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) local: u32,
#ifdef SUBGROUPS
    @builtin(subgroup_invocation_id) lane: u32,
#endif
) {
#ifndef SUBGROUPS
    let lane = 0u;
#endif
    let tiles = (layer.shape.y + TILE - 1u) / TILE;
    let block = group.x + group.y * 65535u;
    let strip = block / tiles;
    let first = (block - strip * tiles) * TILE;
    let count = list[0];
    // Uniform: either all invocations of a workgroup return here or none.
    if strip * 4u * LANES >= count {
        return;
    }
    let columns = strip * 4u * LANES + local + vec4u(0u, LANES, 2u * LANES, 3u * LANES);
    let read = min(columns, vec4u(count - 1u));
    let inputs = layer.shape.x;
    var s0 = mat4x4f();
    var s1 = mat4x4f();
    var s2 = mat4x4f();
    var s3 = mat4x4f();
    var s4 = mat4x4f();
    var s5 = mat4x4f();
    var s6 = mat4x4f();
    var s7 = mat4x4f();
    for (var k = 0u; k < inputs; k += 2u) {
        // An odd last input is paired with itself, with weight zero.
        let next = min(k + 1u, inputs - 1u);
        let x = values_at(read, k);
        let y = select(vec4f(0.0), values_at(read, next), next > k);
        let x0 = weights_at(first, k, lane);
        let x1 = weights_at(first + 8u, k, lane);
        let x2 = weights_at(first + 16u, k, lane);
        let x3 = weights_at(first + 24u, k, lane);
        let y0 = weights_at(first, next, lane);
        let y1 = weights_at(first + 8u, next, lane);
        let y2 = weights_at(first + 16u, next, lane);
        let y3 = weights_at(first + 24u, next, lane);
        s0 += outer(x, x0.low) + outer(y, y0.low);
        s1 += outer(x, x0.high) + outer(y, y0.high);
        s2 += outer(x, x1.low) + outer(y, y1.low);
        s3 += outer(x, x1.high) + outer(y, y1.high);
        s4 += outer(x, x2.low) + outer(y, y2.low);
        s5 += outer(x, x2.high) + outer(y, y2.high);
        s6 += outer(x, x3.low) + outer(y, y3.low);
        s7 += outer(x, x3.high) + outer(y, y3.high);
    }
    finish_four(first, columns, count, s0);
    finish_four(first + 4u, columns, count, s1);
    finish_four(first + 8u, columns, count, s2);
    finish_four(first + 12u, columns, count, s3);
    finish_four(first + 16u, columns, count, s4);
    finish_four(first + 20u, columns, count, s5);
    finish_four(first + 24u, columns, count, s6);
    finish_four(first + 28u, columns, count, s7);
}
