// As `dense`, for software adapters: results[o][i] = sum over k of W(o, k) source[k][i], then bias and ReLU, or the gate of a
// ReLU. Column-major data in rows of a multiple of four columns; the weights as `pack_weights` lays them out.
//
// A CPU has few vector registers, masks every assignment that outlives an iteration of a loop, and reads its stack as fast as
// registers. So an invocation first reads all inputs of four columns, and then computes one output after another, each in one
// register. Lanes read the weights, four inputs each, and share them. More than 4 BLOCKS inputs are taken in several turns.
#import tcgs::permute::part_of

struct Layer {
    // inputs, outputs, vectors of four columns in a row, inputs a turn: 4 BLOCKS (not a constant, lest the loop be unrolled)
    shape: vec4u,
    // first row in the input, first row in the output, first row in the gate, first bias (or NONE)
    places: vec4u,
    // vectors of weights an output, first of them, unused, unused
    packing: vec4u,
}

const NONE: u32 = 0xffffffffu;
const LANES: u32 = 8u;
const BLOCKS: u32 = #{BLOCKS}u;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> weights: array<vec4f>;
@group(0) @binding(3) var<storage, read> source: array<vec4f>;
#if MODE == 2
@group(0) @binding(4) var<storage, read> gate: array<vec4f>;
#else
@group(0) @binding(4) var<storage, read> biases: array<f32>;
#endif
@group(0) @binding(5) var<storage, read_write> results: array<vec4f>;

@compute @workgroup_size(LANES)
fn dense_software(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
    @builtin(subgroup_invocation_id) subgroup_lane: u32,
) {
    let lane = subgroup_lane & 7u;
    let strip = part_of(group, groups);
    // Uniform: either all invocations of a workgroup return here or none.
    if strip * 4u * LANES >= list[0] {
        return;
    }
    let row = layer.shape.z;
    let column = min(strip * LANES + local, row - 1u);
    let inputs = layer.shape.x;
    var x: array<vec4f, 4u * BLOCKS>;
    for (var done = 0u; done < inputs; done += layer.shape.w) {
        for (var k = 0u; k < layer.shape.w; k++) {
            // Inputs past the last have weight zero.
            x[k] = source[(layer.places.x + min(done + k, inputs - 1u)) * row + column];
        }
        for (var output = 0u; output < layer.shape.y; output++) {
            let first = layer.packing.y + output * layer.packing.x + done / 4u + lane;
            let w0 = weights[first];
#if BLOCKS > 8
            let w8 = weights[first + 8u];
#endif
#if BLOCKS > 16
            let w16 = weights[first + 16u];
#endif
            let place = (layer.places.y + output) * row + column;
            var sum = vec4f(0.0);
            if done > 0u {
                sum = results[place];
            }
            sum += mat4x4f(x[0], x[1], x[2], x[3]) * subgroupBroadcast(w0, 0u);
#if BLOCKS > 1
            sum += mat4x4f(x[4], x[5], x[6], x[7]) * subgroupBroadcast(w0, 1u);
#endif
#if BLOCKS > 2
            sum += mat4x4f(x[8], x[9], x[10], x[11]) * subgroupBroadcast(w0, 2u);
#endif
#if BLOCKS > 3
            sum += mat4x4f(x[12], x[13], x[14], x[15]) * subgroupBroadcast(w0, 3u);
#endif
#if BLOCKS > 4
            sum += mat4x4f(x[16], x[17], x[18], x[19]) * subgroupBroadcast(w0, 4u);
#endif
#if BLOCKS > 5
            sum += mat4x4f(x[20], x[21], x[22], x[23]) * subgroupBroadcast(w0, 5u);
#endif
#if BLOCKS > 6
            sum += mat4x4f(x[24], x[25], x[26], x[27]) * subgroupBroadcast(w0, 6u);
#endif
#if BLOCKS > 7
            sum += mat4x4f(x[28], x[29], x[30], x[31]) * subgroupBroadcast(w0, 7u);
#endif
#if BLOCKS > 8
            sum += mat4x4f(x[32], x[33], x[34], x[35]) * subgroupBroadcast(w8, 0u);
#endif
#if BLOCKS > 9
            sum += mat4x4f(x[36], x[37], x[38], x[39]) * subgroupBroadcast(w8, 1u);
#endif
#if BLOCKS > 10
            sum += mat4x4f(x[40], x[41], x[42], x[43]) * subgroupBroadcast(w8, 2u);
#endif
#if BLOCKS > 11
            sum += mat4x4f(x[44], x[45], x[46], x[47]) * subgroupBroadcast(w8, 3u);
#endif
#if BLOCKS > 12
            sum += mat4x4f(x[48], x[49], x[50], x[51]) * subgroupBroadcast(w8, 4u);
#endif
#if BLOCKS > 13
            sum += mat4x4f(x[52], x[53], x[54], x[55]) * subgroupBroadcast(w8, 5u);
#endif
#if BLOCKS > 14
            sum += mat4x4f(x[56], x[57], x[58], x[59]) * subgroupBroadcast(w8, 6u);
#endif
#if BLOCKS > 15
            sum += mat4x4f(x[60], x[61], x[62], x[63]) * subgroupBroadcast(w8, 7u);
#endif
#if BLOCKS > 16
            sum += mat4x4f(x[64], x[65], x[66], x[67]) * subgroupBroadcast(w16, 0u);
#endif
#if BLOCKS > 17
            sum += mat4x4f(x[68], x[69], x[70], x[71]) * subgroupBroadcast(w16, 1u);
#endif
#if BLOCKS > 18
            sum += mat4x4f(x[72], x[73], x[74], x[75]) * subgroupBroadcast(w16, 2u);
#endif
#if BLOCKS > 19
            sum += mat4x4f(x[76], x[77], x[78], x[79]) * subgroupBroadcast(w16, 3u);
#endif
#if BLOCKS > 20
            sum += mat4x4f(x[80], x[81], x[82], x[83]) * subgroupBroadcast(w16, 4u);
#endif
#if BLOCKS > 21
            sum += mat4x4f(x[84], x[85], x[86], x[87]) * subgroupBroadcast(w16, 5u);
#endif
#if BLOCKS > 22
            sum += mat4x4f(x[88], x[89], x[90], x[91]) * subgroupBroadcast(w16, 6u);
#endif
#if BLOCKS > 23
            sum += mat4x4f(x[92], x[93], x[94], x[95]) * subgroupBroadcast(w16, 7u);
#endif
            if done + layer.shape.w >= inputs {
#if MODE == 2
                let open = gate[(layer.places.z + output) * row + column] > vec4f(0.0);
                sum = select(vec4f(0.0), sum, open);
#else
                if layer.places.w != NONE {
                    sum += biases[layer.places.w + output];
                }
#endif
#if MODE == 1
                sum = max(sum, vec4f(0.0));
#endif
            }
            results[place] = sum;
        }
    }
}
