// Weights as the context model's layers are stored: integers of at most `levels` over a power of two, the largest of which
// no weight of the row exceeds them with. One row an invocation; reads one array, writes another.

struct Rows {
    // rows, first weight, from a row to the next, unused
    shape: vec4u,
    // blocks of a row, from a block to the next, weights of a block, levels
    row: vec4u,
}

// Most binary places of a weight.
const MOST_PLACES: u32 = 15u;

@group(0) @binding(0) var<uniform> rows: Rows;
@group(0) @binding(1) var<storage, read> source: array<f32>;
@group(0) @binding(2) var<storage, read_write> results: array<f32>;

// Exact, unlike exp2 on some devices.
fn power_of_two(exponent: u32) -> f32 {
    return bitcast<f32>((127u + exponent) << 23u);
}

@compute @workgroup_size(64)
fn round_weights(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = (group.x + group.y * 65535u) * 64u + local;
    if row >= rows.shape.x {
        return;
    }
    let first = rows.shape.y + row * rows.shape.z;
    let levels = f32(rows.row.w);
    var largest = 0.0;
    for (var block = 0u; block < rows.row.x; block++) {
        for (var i = 0u; i < rows.row.z; i++) {
            largest = max(largest, abs(source[first + block * rows.row.y + i]));
        }
    }
    var places = MOST_PLACES;
    while places > 0u && round(largest * power_of_two(places)) > levels {
        places--;
    }
    let scale = power_of_two(places);
    for (var block = 0u; block < rows.row.x; block++) {
        for (var i = 0u; i < rows.row.z; i++) {
            let at = first + block * rows.row.y + i;
            results[at] = clamp(round(source[at] * scale), -levels, levels) / scale;
        }
    }
}
