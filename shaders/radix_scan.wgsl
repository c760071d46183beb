// For each digit: exclusive prefix sums of its counters over the blocks, and their total. A workgroup has one digit.

struct SortParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    shift: u32,
    digits: u32,
}

const LANES: u32 = 256u;
const BLOCK: u32 = 2048u;

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: array<u32>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;

// Two copies, written in turns, so that each step needs one barrier.
var<workgroup> sums: array<u32, 2u * LANES>;

@compute @workgroup_size(LANES)
fn radix_scan(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let count = min(counts[params.count_index], params.capacity);
    let blocks = (count + BLOCK - 1u) / BLOCK;
    let row = group.x * blocks;
    let length = (blocks + LANES - 1u) / LANES;
    let begin = min(lane * length, blocks);
    let end = min(begin + length, blocks);
    var own = 0u;
    for (var block = begin; block < end; block++) {
        own += counters[row + block];
    }
    var sum = own;
    var copy = 0u;
    for (var reach = 1u; reach < LANES; reach *= 2u) {
        sums[copy + lane] = sum;
        workgroupBarrier();
        if lane >= reach {
            sum += sums[copy + lane - reach];
        }
        copy = LANES - copy;
    }
    var before = sum - own;
    for (var block = begin; block < end; block++) {
        let value = counters[row + block];
        counters[row + block] = before;
        before += value;
    }
    if lane == LANES - 1u {
        totals[group.x] = sum;
    }
}
