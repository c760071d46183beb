// Writes the exclusive prefix sum of each run, starting from the sum of the runs before it.

struct ScanParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    total_index: u32,
}

@group(0) @binding(0) var<uniform> params: ScanParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read> partials: array<u32>;
@group(0) @binding(4) var<storage, read_write> sums: array<u32>;

@compute @workgroup_size(32)
fn scan_apply(@builtin(global_invocation_id) id: vec3u) {
    let run = id.x;
    if run >= params.runs {
        return;
    }
    let count = min(counts[params.count_index], params.capacity);
    let length = (count + params.runs - 1u) / params.runs;
    let begin = min(run * length, count);
    let end = min(begin + length, count);
    var sum = partials[run];
    for (var i = begin; i < end; i++) {
        sums[i] = sum;
        let next = sum + values[i];
        sum = select(next, 0xffffffffu, next < sum);
    }
}
