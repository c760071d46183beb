// Writes the exclusive prefix sums of each block of values, starting from the sum of the blocks before it, and the total. Sums
// saturate.

struct ScanParams {
    runs: u32,
    count_index: u32,
    capacity: u32,
    total_index: u32,
}

const LANES: u32 = 256u;
const VALUES: u32 = 8u;
const BLOCK: u32 = LANES * VALUES;

@group(0) @binding(0) var<uniform> params: ScanParams;
@group(0) @binding(1) var<storage, read> values: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<u32>;
@group(0) @binding(3) var<storage, read_write> prefix_sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> totals: array<u32>;

// Of the blocks before this one, and of this block's lanes. Two copies, written in turns, so that each step needs one barrier.
var<workgroup> sums: array<vec2u, 2u * LANES>;

fn add(a: vec2u, b: vec2u) -> vec2u {
    let sum = a + b;
    return select(sum, vec2u(0xffffffffu), sum < a);
}

@compute @workgroup_size(LANES)
fn scan_blocks(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let count = partials[0];
    let block = group.x + group.y * 65535u;
    let first = block * BLOCK;
    // Uniform: all invocations of a workgroup return here or none. The first block writes the total even if there is no value.
    if block > 0u && first >= count {
        return;
    }
    var own = vec2u(0u);
    for (var other = lane; other < block; other += LANES) {
        own = add(own, vec2u(partials[1u + other], 0u));
    }
    let begin = first + lane * VALUES;
    let end = min(begin + VALUES, count);
    for (var i = begin; i < end; i++) {
        own = add(own, vec2u(0u, values[i]));
    }
    var sum = own;
    var copy = 0u;
    for (var reach = 1u; reach < LANES; reach *= 2u) {
        sums[copy + lane] = sum;
        workgroupBarrier();
        if lane >= reach {
            sum = add(sum, sums[copy + lane - reach]);
        }
        copy = LANES - copy;
    }
    sums[copy + lane] = sum;
    workgroupBarrier();
    let start = vec2u(sums[copy + LANES - 1u].x, 0u);
    var running = start.x;
    if lane > 0u {
        running = add(start, vec2u(sums[copy + lane - 1u].y, 0u)).x;
    }
    for (var i = begin; i < end; i++) {
        prefix_sums[i] = running;
        running = add(vec2u(running, 0u), vec2u(values[i], 0u)).x;
    }
    if lane == LANES - 1u && first + BLOCK >= count {
        totals[params.total_index] = running;
    }
}
