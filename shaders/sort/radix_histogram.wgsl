// Counts the digits of each block of keys: counters[digit][block]. Counts do not depend on the order of the additions.
#import tcgs::blocks::{SortParams, LANES, ITEMS, BLOCK, block_of, blocks_of}

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters: array<u32>;

var<workgroup> bins: array<atomic<u32>, LANES>;

@compute @workgroup_size(LANES)
fn radix_histogram(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let count = min(counts[params.count_index], params.capacity);
    let block = block_of(group);
    let first = block * BLOCK;
    // Uniform: all invocations of a workgroup return here or none.
    if first >= count {
        return;
    }
    atomicStore(&bins[lane], 0u);
    workgroupBarrier();
    for (var k = 0u; k < ITEMS; k++) {
        let i = first + k * LANES + lane;
        if i < count {
            atomicAdd(&bins[(keys[i] >> params.shift) & (params.digits - 1u)], 1u);
        }
    }
    workgroupBarrier();
    if lane < params.digits {
        counters[lane * blocks_of(count) + block] = atomicLoad(&bins[lane]);
    }
}
