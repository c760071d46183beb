// Moves each invocation's run of keys and values to their places; runs and keys in order, so the sort is stable.

struct SortParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    shift: u32,
    digits: u32,
}

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> totals: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters: array<u32>;
@group(0) @binding(4) var<storage, read> keys: array<u32>;
@group(0) @binding(5) var<storage, read> values: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_values: array<u32>;

@compute @workgroup_size(16)
fn sort_scatter(@builtin(global_invocation_id) id: vec3u) {
    let run = id.x;
    if run >= params.runs {
        return;
    }
    let count = min(counts[params.count_index], params.capacity);
    let length = (count + params.runs - 1u) / params.runs;
    let begin = min(run * length, count);
    let end = min(begin + length, count);
    var base = 0u;
    for (var digit = 0u; digit < params.digits; digit++) {
        counters[digit * params.runs + run] += base;
        base += totals[digit];
    }
    for (var i = begin; i < end; i++) {
        let key = keys[i];
        let counter = ((key >> params.shift) & (params.digits - 1u)) * params.runs + run;
        let place = counters[counter];
        counters[counter] = place + 1u;
        sorted_keys[place] = key;
        sorted_values[place] = values[i];
    }
}
