// Lists the visible anchors in ascending order from the counts of their blocks: list[0] is how many there are, list[1..] their
// indices.
#import tcgs::anchor_view::View
#import tcgs::blocks::{LANES, ITEMS, BLOCK, block_of, lane_sums, sum_of_lanes}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read> block_counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> list: array<u32>;

@compute @workgroup_size(LANES)
fn list_visible_anchors(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = block_of(group);
    let count = view.counts.x;
    // Of the blocks before this one, and of this block's lane.
    var own = vec2u(0u);
    for (var other = lane; other < block; other += LANES) {
        own.x += block_counts[other];
    }
    let begin = min(block * BLOCK + lane * ITEMS, count);
    let end = min(begin + ITEMS, count);
    for (var anchor = begin; anchor < end; anchor++) {
        own.y += visible[anchor];
    }
    let sum = lane_sums(lane, own);
    var next = sum_of_lanes().x + sum.y - own.y;
    for (var anchor = begin; anchor < end; anchor++) {
        if visible[anchor] != 0u {
            list[1u + next] = anchor;
            next++;
        }
    }
    if lane == LANES - 1u && (block + 1u) * BLOCK >= count {
        list[0] = next;
    }
}
