// For each digit: exclusive prefix sums of its counters over the blocks, and their total. A workgroup has one digit.
#import tcgs::blocks::{SortParams, LANES, blocks_of, lane_sums}

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: array<u32>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;

@compute @workgroup_size(LANES)
fn radix_scan(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let blocks = blocks_of(min(counts[params.count_index], params.capacity));
    let row = group.x * blocks;
    let length = (blocks + LANES - 1u) / LANES;
    let begin = min(lane * length, blocks);
    let end = min(begin + length, blocks);
    var own = 0u;
    for (var block = begin; block < end; block++) {
        own += counters[row + block];
    }
    let sum = lane_sums(lane, vec2u(own, 0u)).x;
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
