// Counts the visible anchors of each block of anchors.
#import tcgs::anchor_view::View
#import tcgs::blocks::{LANES, ITEMS, BLOCK, block_of, lane_sums}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read_write> block_counts: array<u32>;

@compute @workgroup_size(LANES)
fn count_visible_anchors(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = block_of(group);
    var own = 0u;
    for (var k = 0u; k < ITEMS; k++) {
        let anchor = block * BLOCK + k * LANES + lane;
        if anchor < view.counts.x {
            own += visible[anchor];
        }
    }
    let sum = lane_sums(lane, vec2u(own, 0u));
    if lane == LANES - 1u {
        block_counts[block] = sum.x;
    }
}
