// As `dense_weight_gradient`, for software adapters: partial sums, over one run of columns, of the gradient of a layer's weights
// and bias. A run's sums are those of all layers, of each in rows of outputs, padded to a multiple of four, one row an input and one of the bias;
// `sum_weight_gradient` adds the runs in order. Column-major data in rows of a multiple of four columns.
//
// For the reasons of `dense_software`, an invocation holds the gradients of four outputs at BLOCK columns and computes the sums
// of one input after another. Lanes read the input's values, four columns each, and share them.
#import tcgs::permute::part_of

struct Layer {
    // inputs, outputs, vectors of four columns in a row, columns a run (a multiple of BLOCK)
    shape: vec4u,
    // first row in the input, first row in the output gradient, BLOCK (not a constant, lest the loop be unrolled), unused
    places: vec4u,
    // first vector in a run's sums, vectors of all layers there, unused, unused
    sums: vec4u,
}

const LANES: u32 = 8u;
const BLOCK: u32 = 64u;

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> source: array<vec4f>;
@group(0) @binding(3) var<storage, read> dout: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> partials: array<vec4f>;

// Values past the end are zero, whatever the buffer holds there.
fn until(end: u32, column: u32, values: vec4f) -> vec4f {
    return select(vec4f(0.0), values, 4u * column + vec4u(0u, 1u, 2u, 3u) < vec4u(end));
}

@compute @workgroup_size(LANES)
fn dense_weight_gradient_software(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let inputs = layer.shape.x;
    let outputs = layer.shape.y;
    let columns = layer.shape.z;
    let row = (outputs + 3u) / 4u;
    let tiles = (row + LANES - 1u) / LANES;
    let place = part_of(group, groups);
    let run = place / tiles;
    let four = (place - run * tiles) * LANES + lane;
    let begin = run * layer.shape.w;
    let end = min(begin + layer.shape.w, list[0]);
    // d[4 i + j]: output j of the four at the i-th vector of columns.
    var d: array<vec4f, BLOCK>;
    for (var start = begin; start < end; start += layer.places.z) {
        let first = start / 4u;
        for (var i = 0u; i < layer.places.z; i++) {
            let output = min(4u * four + i % 4u, outputs - 1u);
            let column = first + i / 4u;
            d[i] = until(end, column, dout[(layer.places.y + output) * columns + min(column, columns - 1u)]);
        }
        let column0 = first + lane;
        let column8 = first + 8u + lane;
        let at0 = min(column0, columns - 1u);
        let at8 = min(column8, columns - 1u);
        for (var input = 0u; input <= inputs; input++) {
            // The bias is the weight of a constant input.
            let constant = input == inputs;
            let source_row = (layer.places.x + min(input, inputs - 1u)) * columns;
            let x0 = until(end, column0, select(source[source_row + at0], vec4f(1.0), constant));
            let x8 = until(end, column8, select(source[source_row + at8], vec4f(1.0), constant));
            var sum = vec4f(0.0);
            sum += subgroupBroadcast(x0, 0u) * mat4x4f(d[0], d[1], d[2], d[3]);
            sum += subgroupBroadcast(x0, 1u) * mat4x4f(d[4], d[5], d[6], d[7]);
            sum += subgroupBroadcast(x0, 2u) * mat4x4f(d[8], d[9], d[10], d[11]);
            sum += subgroupBroadcast(x0, 3u) * mat4x4f(d[12], d[13], d[14], d[15]);
            sum += subgroupBroadcast(x0, 4u) * mat4x4f(d[16], d[17], d[18], d[19]);
            sum += subgroupBroadcast(x0, 5u) * mat4x4f(d[20], d[21], d[22], d[23]);
            sum += subgroupBroadcast(x0, 6u) * mat4x4f(d[24], d[25], d[26], d[27]);
            sum += subgroupBroadcast(x0, 7u) * mat4x4f(d[28], d[29], d[30], d[31]);
            sum += subgroupBroadcast(x8, 0u) * mat4x4f(d[32], d[33], d[34], d[35]);
            sum += subgroupBroadcast(x8, 1u) * mat4x4f(d[36], d[37], d[38], d[39]);
            sum += subgroupBroadcast(x8, 2u) * mat4x4f(d[40], d[41], d[42], d[43]);
            sum += subgroupBroadcast(x8, 3u) * mat4x4f(d[44], d[45], d[46], d[47]);
            sum += subgroupBroadcast(x8, 4u) * mat4x4f(d[48], d[49], d[50], d[51]);
            sum += subgroupBroadcast(x8, 5u) * mat4x4f(d[52], d[53], d[54], d[55]);
            sum += subgroupBroadcast(x8, 6u) * mat4x4f(d[56], d[57], d[58], d[59]);
            sum += subgroupBroadcast(x8, 7u) * mat4x4f(d[60], d[61], d[62], d[63]);
            if four < row {
                let to = run * layer.sums.y + layer.sums.x + input * row + four;
                if start > begin {
                    sum += partials[to];
                }
                partials[to] = sum;
            }
        }
    }
}
