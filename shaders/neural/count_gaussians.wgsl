// counts[0] = candidate Gaussians (visible anchors times offsets), counts[1] = Gaussians with positive opacity,
// counts[2] = visible anchors.
#import tcgs::model::OFFSETS

const LANES: u32 = 256u;

@group(0) @binding(0) var<storage, read> list: array<u32>;
@group(0) @binding(1) var<storage, read> alive: array<u32>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

var<workgroup> sums: array<u32, LANES>;

@compute @workgroup_size(LANES)
fn count_gaussians(@builtin(local_invocation_index) local: u32) {
    let count = list[0];
    var mine = 0u;
#ifdef SOFTWARE
    for (var index = local; index < count; index += LANES) {
        mine += alive[index];
    }
#else
    // Eight reads at a time, since each waits for memory.
    var index = local;
    for (; index + 7u * LANES < count; index += 8u * LANES) {
        let a = vec4u(alive[index], alive[index + LANES], alive[index + 2u * LANES], alive[index + 3u * LANES]);
        let next = index + 4u * LANES;
        let b = vec4u(alive[next], alive[next + LANES], alive[next + 2u * LANES], alive[next + 3u * LANES]);
        let four = a + b;
        mine += four.x + four.y + four.z + four.w;
    }
    for (; index < count; index += LANES) {
        mine += alive[index];
    }
#endif
    sums[local] = mine;
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if local < reach {
            sums[local] += sums[local + reach];
        }
        workgroupBarrier();
    }
    if local == 0u {
        counts[0] = count * OFFSETS;
        counts[1] = sums[0];
        counts[2] = count;
    }
}
