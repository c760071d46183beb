// Turns the sums of the runs into exclusive prefix sums, in one workgroup, and writes the total.

struct ScanParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    total_index: u32,
}

const LANES: u32 = 256u;

@group(0) @binding(0) var<uniform> params: ScanParams;
@group(0) @binding(1) var<storage, read_write> partials: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

var<workgroup> sums: array<u32, LANES>;

// Saturating, so that a total beyond 2^32 still reads as too large.
fn add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

@compute @workgroup_size(LANES)
fn scan_partials(@builtin(local_invocation_index) lane: u32) {
    let length = (params.runs + LANES - 1u) / LANES;
    let begin = min(lane * length, params.runs);
    let end = min(begin + length, params.runs);
    var sum = 0u;
    for (var i = begin; i < end; i++) {
        sum = add(sum, partials[i]);
    }
    sums[lane] = sum;
    for (var stride = 1u; stride < LANES; stride *= 2u) {
        workgroupBarrier();
        var before = 0u;
        if lane >= stride {
            before = sums[lane - stride];
        }
        workgroupBarrier();
        sums[lane] = add(sums[lane], before);
    }
    workgroupBarrier();
    var running = 0u;
    if lane > 0u {
        running = sums[lane - 1u];
    }
    for (var i = begin; i < end; i++) {
        let value = partials[i];
        partials[i] = running;
        running = add(running, value);
    }
    if lane == LANES - 1u {
        totals[params.total_index] = sums[lane];
    }
}
