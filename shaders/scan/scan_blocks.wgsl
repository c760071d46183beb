// Writes the exclusive prefix sums of each block of values, starting from the sum of the blocks before it, and the total. Sums
// saturate.
#import tcgs::blocks::{
    ScanParams, LANES, ITEMS, BLOCK, block_of, saturating_add, saturating_lane_sums, sum_before, sum_of_lanes,
}

@group(0) @binding(0) var<uniform> params: ScanParams;
@group(0) @binding(1) var<storage, read> values: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<u32>;
@group(0) @binding(3) var<storage, read_write> prefix_sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> totals: array<u32>;

@compute @workgroup_size(LANES)
fn scan_blocks(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let count = partials[0];
    let block = block_of(group);
    let first = block * BLOCK;
    // Uniform: all invocations of a workgroup return here or none. The first block writes the total even if there is no value.
    if block > 0u && first >= count {
        return;
    }
    // Of the blocks before this one, and of this block's lane.
    var own = vec2u(0u);
    for (var other = lane; other < block; other += LANES) {
        own = saturating_add(own, vec2u(partials[1u + other], 0u));
    }
    let begin = first + lane * ITEMS;
    let end = min(begin + ITEMS, count);
    for (var i = begin; i < end; i++) {
        own = saturating_add(own, vec2u(0u, values[i]));
    }
    saturating_lane_sums(lane, own);
    var running = saturating_add(vec2u(sum_of_lanes().x), vec2u(sum_before(lane).y)).x;
    for (var i = begin; i < end; i++) {
        prefix_sums[i] = running;
        running = saturating_add(vec2u(running), vec2u(values[i])).x;
    }
    if lane == LANES - 1u && first + BLOCK >= count {
        totals[params.total_index] = running;
    }
}
