// The saturating sum of each block of `values`, behind the number of values: partials[0] is that, partials[1 + block] a sum.

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
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> partials: array<u32>;

var<workgroup> sums: array<u32, LANES>;

fn add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

@compute @workgroup_size(LANES)
fn scan_block_sums(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let count = min(counts[params.count_index], params.capacity);
    let block = group.x + group.y * 65535u;
    let first = block * BLOCK;
    if block == 0u && lane == 0u {
        partials[0] = count;
    }
    // Uniform: all invocations of a workgroup return here or none.
    if first >= count {
        return;
    }
    var own = 0u;
    for (var k = 0u; k < VALUES; k++) {
        let i = first + k * LANES + lane;
        if i < count {
            own = add(own, values[i]);
        }
    }
    sums[lane] = own;
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if lane < reach {
            sums[lane] = add(sums[lane], sums[lane + reach]);
        }
        workgroupBarrier();
    }
    if lane == 0u {
        partials[1u + block] = sums[0];
    }
}
