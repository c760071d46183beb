// Counts the visible anchors of each block of anchors.
#import tcgs::anchor_view::View

const LANES: u32 = 256u;
const ANCHORS: u32 = 8u;
const BLOCK: u32 = LANES * ANCHORS;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read_write> block_counts: array<u32>;

var<workgroup> sums: array<u32, LANES>;

@compute @workgroup_size(LANES)
fn count_visible_anchors(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group.x + group.y * 65535u;
    var own = 0u;
    for (var k = 0u; k < ANCHORS; k++) {
        let anchor = block * BLOCK + k * LANES + lane;
        if anchor < view.counts.x {
            own += visible[anchor];
        }
    }
    sums[lane] = own;
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if lane < reach {
            sums[lane] += sums[lane + reach];
        }
        workgroupBarrier();
    }
    if lane == 0u {
        block_counts[block] = sums[0];
    }
}
