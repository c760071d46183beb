// Lists the visible anchors in ascending order from the counts of their blocks: list[0] is how many there are, list[1..] their
// indices.
#import tcgs::anchor_view::View

const LANES: u32 = 256u;
const ANCHORS: u32 = 8u;
const BLOCK: u32 = LANES * ANCHORS;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read> block_counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> list: array<u32>;

// Of the blocks before this one, and of this block's lanes. Two copies, written in turns, so that each step needs one barrier.
var<workgroup> sums: array<vec2u, 2u * LANES>;

@compute @workgroup_size(LANES)
fn list_visible_anchors(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group.x + group.y * 65535u;
    let count = view.counts.x;
    var own = vec2u(0u);
    for (var other = lane; other < block; other += LANES) {
        own.x += block_counts[other];
    }
    let begin = min(block * BLOCK + lane * ANCHORS, count);
    let end = min(begin + ANCHORS, count);
    for (var anchor = begin; anchor < end; anchor++) {
        own.y += visible[anchor];
    }
    var sum = own;
    var copy = 0u;
    for (var reach = 1u; reach < LANES; reach *= 2u) {
        sums[copy + lane] = sum;
        workgroupBarrier();
        if lane >= reach {
            sum += sums[copy + lane - reach];
        }
        copy = LANES - copy;
    }
    sums[copy + lane] = sum;
    workgroupBarrier();
    var next = sums[copy + LANES - 1u].x + sum.y - own.y;
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
