// Partial sums, over one run of visible anchors, of the gradient of a dense layer's weights and bias:
// dW(o, k) = sum over i of dout[o][i] source[k][i]; dbias(o) = sum over i of dout[o][i].
// A workgroup computes a tile of 32 outputs by 16 inputs for one run; `sum_partials` adds the runs in order.
//
// Eight lanes in a row hold the tile, each the outputs o, o + 8, o + 16 and o + 24 by all sixteen inputs. They read the
// inputs' values once, two a lane, and share them, since reads dominate on a software adapter. Where a subgroup has more
// lanes, every further eight process other anchors of the run.

#import tcgs::index::group_index
#import tcgs::runs::run_length

struct Layer {
    // inputs, outputs, capacity, weights
    shape: vec4u,
    // out_stride, in_stride, bias, unused
    access: vec4u,
    // first row in the input, first row in the output gradient, parameters in all, unused
    rows: vec4u,
}

const LANES: u32 = #{GRADIENT_LANES}u;
const PHASES: u32 = LANES / 8u;
const INPUTS: u32 = 16u;
const OUTPUTS: u32 = 32u;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> source: array<f32>;
@group(0) @binding(3) var<storage, read> dout: array<f32>;
@group(0) @binding(4) var<storage, read_write> partials: array<f32>;

// Values of eight inputs.
struct Eight {
    low: vec4f,
    high: vec4f,
}

fn source_at(input: u32, column: u32) -> f32 {
    return source[(min(input, layer.shape.x - 1u) + layer.rows.x) * layer.shape.z + column];
}

fn dout_at(output: u32, column: u32) -> f32 {
    return dout[(min(output, layer.shape.y - 1u) + layer.rows.y) * layer.shape.z + column];
}

#ifdef SUBGROUPS
fn eight_inputs(input: u32, column: u32, lane: u32) -> Eight {
    let own = source_at(input + (lane & 7u), column);
#if GRADIENT_LANES == 8
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
#else
    let base = lane & ~7u;
    return Eight(
        vec4f(
            subgroupShuffle(own, base),
            subgroupShuffle(own, base + 1u),
            subgroupShuffle(own, base + 2u),
            subgroupShuffle(own, base + 3u),
        ),
        vec4f(
            subgroupShuffle(own, base + 4u),
            subgroupShuffle(own, base + 5u),
            subgroupShuffle(own, base + 6u),
            subgroupShuffle(own, base + 7u),
        ),
    );
#endif
}

// The sum over the phases, always added in the same order.
fn total(value: vec4f, lane: u32) -> vec4f {
    var sum = value;
    for (var reach = 8u; reach < LANES; reach *= 2u) {
        sum += subgroupShuffleXor(sum, reach);
    }
    return sum;
}
#else
var<workgroup> shared_sums: array<vec4f, LANES>;

fn eight_inputs(input: u32, column: u32, lane: u32) -> Eight {
    return Eight(
        vec4f(
            source_at(input, column),
            source_at(input + 1u, column),
            source_at(input + 2u, column),
            source_at(input + 3u, column),
        ),
        vec4f(
            source_at(input + 4u, column),
            source_at(input + 5u, column),
            source_at(input + 6u, column),
            source_at(input + 7u, column),
        ),
    );
}

// The sum over the phases, always added in the same order.
fn total(value: vec4f, lane: u32) -> vec4f {
    workgroupBarrier();
    shared_sums[lane] = value;
    workgroupBarrier();
    var sum = vec4f(0.0);
    for (var phase = 0u; phase < PHASES; phase++) {
        sum += shared_sums[8u * phase + (lane & 7u)];
    }
    return sum;
}
#endif

// One matrix column an output.
fn outer(inputs: vec4f, gradients: vec4f) -> mat4x4f {
    return mat4x4f(
        gradients.x * inputs,
        gradients.y * inputs,
        gradients.z * inputs,
        gradients.w * inputs,
    );
}

fn store(base: u32, output: u32, input: u32, sums: vec4f) {
    for (var i = 0u; i < 4u; i++) {
        if output < layer.shape.y && input + i < layer.shape.x {
            partials[base + layer.shape.w + output * layer.access.x + (input + i) * layer.access.y] = sums[i];
        }
    }
}

@compute @workgroup_size(LANES)
fn dense_weight_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let input_tiles = (layer.shape.x + INPUTS - 1u) / INPUTS;
    let output_tiles = (layer.shape.y + OUTPUTS - 1u) / OUTPUTS;
    let block = group_index(group);
    let k = (block % input_tiles) * INPUTS;
    let first = ((block / input_tiles) % output_tiles) * OUTPUTS;
    let run = block / (input_tiles * output_tiles);
    let length = run_length(list[0]);
    let begin = run * length;
    let end = min(begin + length, list[0]);
    // Uniform: either all invocations of a workgroup return here or none.
    if begin >= end {
        return;
    }
    let base = run * layer.rows.z;
    let o = first + (lane & 7u);

    var s0 = mat4x4f();
    var s1 = mat4x4f();
    var s2 = mat4x4f();
    var s3 = mat4x4f();
    var bias = vec4f(0.0);
    // The bound is the same for all lanes, since they share what they read; a column past the end has weight zero.
    for (var i = begin; i < end; i += 2u * PHASES) {
        let at = i + (lane / 8u);
        let next = at + PHASES;
        let here = min(at, end - 1u);
        let there = min(next, end - 1u);
        let x_low = eight_inputs(k, here, lane);
        let x_high = eight_inputs(k + 8u, here, lane);
        let y_low = eight_inputs(k, there, lane);
        let y_high = eight_inputs(k + 8u, there, lane);
        let d = select(
            vec4f(0.0),
            vec4f(dout_at(o, here), dout_at(o + 8u, here), dout_at(o + 16u, here), dout_at(o + 24u, here)),
            at < end,
        );
        let e = select(
            vec4f(0.0),
            vec4f(dout_at(o, there), dout_at(o + 8u, there), dout_at(o + 16u, there), dout_at(o + 24u, there)),
            next < end,
        );
        s0 += outer(x_low.low, d) + outer(y_low.low, e);
        s1 += outer(x_low.high, d) + outer(y_low.high, e);
        s2 += outer(x_high.low, d) + outer(y_high.low, e);
        s3 += outer(x_high.high, d) + outer(y_high.high, e);
        bias += d + e;
    }
    var sums = array<mat4x4f, 4>(s0, s1, s2, s3);
    for (var part = 0u; part < 16u; part++) {
        let sum = total(sums[part / 4u][part % 4u], lane);
        if lane < 8u {
            store(base, o + 8u * (part % 4u), k + 4u * (part / 4u), sum);
        }
    }
    let bias_sum = total(bias, lane);
    if k == 0u && lane < 8u {
        for (var i = 0u; i < 4u; i++) {
            if o + 8u * i < layer.shape.y {
                partials[base + layer.access.z + o + 8u * i] = bias_sum[i];
            }
        }
    }
}
