// For each digit: exclusive prefix sums of its counters over the runs, and their total.

struct SortParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    shift: u32,
    digits: u32,
}

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read_write> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

@compute @workgroup_size(16)
fn sort_offsets(@builtin(global_invocation_id) id: vec3u) {
    let digit = id.x;
    if digit >= params.digits {
        return;
    }
    var sum = 0u;
    for (var run = 0u; run < params.runs; run++) {
        let i = digit * params.runs + run;
        let value = counters[i];
        counters[i] = sum;
        sum += value;
    }
    totals[digit] = sum;
}
