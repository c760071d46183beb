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
    for (var index = local; index < count; index += LANES) {
        mine += alive[index];
    }
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
