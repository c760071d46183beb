// Counts the digits of each invocation's contiguous run of keys: counters[digit][run].

struct SortParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    shift: u32,
    digits: u32,
}

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters: array<u32>;

@compute @workgroup_size(16)
fn sort_count(@builtin(global_invocation_id) id: vec3u) {
    let run = id.x;
    if run >= params.runs {
        return;
    }
    for (var digit = 0u; digit < params.digits; digit++) {
        counters[digit * params.runs + run] = 0u;
    }
    let count = min(counts[params.count_index], params.capacity);
    let length = (count + params.runs - 1u) / params.runs;
    let begin = min(run * length, count);
    let end = min(begin + length, count);
    for (var i = begin; i < end; i++) {
        let digit = (keys[i] >> params.shift) & (params.digits - 1u);
        counters[digit * params.runs + run] += 1u;
    }
}
