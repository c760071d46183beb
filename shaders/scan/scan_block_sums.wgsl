// The saturating sum of each block of `values`, behind the number of values: partials[0] is that, partials[1 + block] a sum.
#import tcgs::blocks::{ScanParams, LANES, ITEMS, BLOCK, block_of, saturating_add, saturating_lane_sums}

@group(0) @binding(0) var<uniform> params: ScanParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> partials: array<u32>;

@compute @workgroup_size(LANES)
fn scan_block_sums(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let count = min(counts[params.count_index], params.capacity);
    let block = block_of(group);
    let first = block * BLOCK;
    if block == 0u && lane == 0u {
        partials[0] = count;
    }
    // Uniform: all invocations of a workgroup return here or none.
    if first >= count {
        return;
    }
    var own = vec2u(0u);
    for (var k = 0u; k < ITEMS; k++) {
        let i = first + k * LANES + lane;
        if i < count {
            own = saturating_add(own, vec2u(values[i], 0u));
        }
    }
    let sum = saturating_lane_sums(lane, own);
    if lane == LANES - 1u {
        partials[1u + block] = sum.x;
    }
}
