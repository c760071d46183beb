// Partial sums, over one run of visible anchors, of the gradient of a dense layer's weights and bias:
// dW(o, k) = sum over i of dout[o][i] source[k][i]; dbias(o) = sum over i of dout[o][i].
// A workgroup computes a tile of 4 outputs by 8 inputs for one run; `sum_partials` adds the runs in order.

struct Layer {
    // inputs, outputs, capacity, weights
    shape: vec4u,
    // out_stride, in_stride, bias, columns a run
    access: vec4u,
    // first row in the input, first row in the output gradient, parameters in all, unused
    rows: vec4u,
}

const LANES: u32 = #{GRADIENT_LANES}u;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> source: array<f32>;
@group(0) @binding(3) var<storage, read> dout: array<f32>;
@group(0) @binding(4) var<storage, read_write> partials: array<f32>;

#ifndef SUBGROUPS
var<workgroup> shared_sums: array<vec4f, LANES>;
#endif

// The sum over the workgroup, known to its first lane at least; always added in the same order.
fn total(value: vec4f, local: u32) -> vec4f {
#ifdef SUBGROUPS
    return subgroupAdd(value);
#else
    workgroupBarrier();
    shared_sums[local] = value;
    workgroupBarrier();
    var sum = vec4f(0.0);
    if local == 0u {
        for (var i = 0u; i < LANES; i++) {
            sum += shared_sums[i];
        }
    }
    return sum;
#endif
}

fn store(base: u32, output: u32, input: u32, values: vec4f) {
    if output >= layer.shape.y {
        return;
    }
    for (var i = 0u; i < 4u; i++) {
        if input + i < layer.shape.x {
            let at = layer.shape.w + output * layer.access.x + (input + i) * layer.access.y;
            partials[base + at] = values[i];
        }
    }
}

@compute @workgroup_size(LANES)
fn dense_weight_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let input_tiles = (layer.shape.x + 7u) / 8u;
    let output_tiles = (layer.shape.y + 3u) / 4u;
    let block = group.x + group.y * 65535u;
    let k = (block % input_tiles) * 8u;
    let o = ((block / input_tiles) % output_tiles) * 4u;
    let run = block / (input_tiles * output_tiles);
    let capacity = layer.shape.z;
    let count = list[0];
    let begin = run * layer.access.w;
    let end = min(begin + layer.access.w, count);
    let base = run * layer.rows.z;

    let in_row = vec4u(k, k + 1u, k + 2u, k + 3u);
    let last_in = vec4u(layer.shape.x - 1u);
    let low = (min(in_row, last_in) + layer.rows.x) * capacity;
    let high = (min(in_row + 4u, last_in) + layer.rows.x) * capacity;
    let out_row = (min(vec4u(o, o + 1u, o + 2u, o + 3u), vec4u(layer.shape.y - 1u)) + layer.rows.y) * capacity;

    var a0 = vec4f(0.0);
    var a1 = vec4f(0.0);
    var a2 = vec4f(0.0);
    var a3 = vec4f(0.0);
    var b0 = vec4f(0.0);
    var b1 = vec4f(0.0);
    var b2 = vec4f(0.0);
    var b3 = vec4f(0.0);
    var bias = vec4f(0.0);
    for (var i = begin + local; i < end; i += LANES) {
        let x = vec4f(source[low.x + i], source[low.y + i], source[low.z + i], source[low.w + i]);
        let y = vec4f(source[high.x + i], source[high.y + i], source[high.z + i], source[high.w + i]);
        let d = vec4f(dout[out_row.x + i], dout[out_row.y + i], dout[out_row.z + i], dout[out_row.w + i]);
        a0 += d.x * x;
        a1 += d.y * x;
        a2 += d.z * x;
        a3 += d.w * x;
        b0 += d.x * y;
        b1 += d.y * y;
        b2 += d.z * y;
        b3 += d.w * y;
        bias += d;
    }
    var sums = array<vec4f, 9>(
        total(a0, local), total(a1, local), total(a2, local), total(a3, local),
        total(b0, local), total(b1, local), total(b2, local), total(b3, local),
        total(bias, local),
    );
    if local != 0u {
        return;
    }
    for (var i = 0u; i < 4u; i++) {
        store(base, o + i, k, sums[i]);
        store(base, o + i, k + 4u, sums[4u + i]);
        if k == 0u && o + i < layer.shape.y {
            partials[base + layer.access.z + o + i] = sums[8][i];
        }
    }
}
