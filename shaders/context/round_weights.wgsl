// Weights as the context model's layers are stored: integers over a power of two, for each row the largest with which no
// weight's integer exceeds the row's levels. One row an invocation; reads one array, writes another.

#import tcgs::index::lane_index

struct Shape {
    // rows, levels of rows that state none, unused
    shape: vec4u,
}

struct Row {
    first: u32,
    blocks: u32,
    // from a block to the next
    step: u32,
    // weights of a block
    length: u32,
    levels: u32,
}

// Most fraction bits of a weight in a file.
const MAX_FRACTION_BITS: i32 = 15;

@group(0) @binding(0) var<uniform> shape: Shape;
@group(0) @binding(1) var<storage, read> rows: array<Row>;
@group(0) @binding(2) var<storage, read> source: array<f32>;
@group(0) @binding(3) var<storage, read_write> results: array<f32>;

// Exact, unlike exp2 on some devices; products with it are exact too, unlike quotients.
fn power_of_two(exponent: i32) -> f32 {
    return bitcast<f32>(u32(127 + exponent) << 23u);
}

@compute @workgroup_size(64)
fn round_weights(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    if index >= shape.shape.x {
        return;
    }
    let row = rows[index];
    let levels = f32(select(row.levels, shape.shape.y, row.levels == 0u));
    var largest = 0.0;
    for (var block = 0u; block < row.blocks; block++) {
        for (var i = 0u; i < row.length; i++) {
            largest = max(largest, abs(source[row.first + block * row.step + i]));
        }
    }
    var places = MAX_FRACTION_BITS;
    while places > 0 && round(largest * power_of_two(places)) > levels {
        places--;
    }
    let scale = power_of_two(places);
    let unit = power_of_two(-places);
    for (var block = 0u; block < row.blocks; block++) {
        for (var i = 0u; i < row.length; i++) {
            let at = row.first + block * row.step + i;
            results[at] = clamp(round(source[at] * scale), -levels, levels) * unit;
        }
    }
}
