// Lists the visible anchors in ascending order: list[0] is how many there are, list[1..] their indices.
// One workgroup; each invocation owns a contiguous run, so the order does not depend on timing.
#import tcgs::anchor_view::View

const LANES: u32 = 256u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read_write> list: array<u32>;

var<workgroup> starts: array<u32, LANES>;

@compute @workgroup_size(LANES)
fn compact_anchors(@builtin(local_invocation_index) local: u32) {
    let count = view.counts.x;
    let run = (count + LANES - 1u) / LANES;
    let first = min(local * run, count);
    let last = min(first + run, count);
    var mine = 0u;
    for (var anchor = first; anchor < last; anchor++) {
        mine += visible[anchor];
    }
    starts[local] = mine;
    workgroupBarrier();
    for (var reach = 1u; reach < LANES; reach *= 2u) {
        var before = 0u;
        if local >= reach {
            before = starts[local - reach];
        }
        workgroupBarrier();
        starts[local] += before;
        workgroupBarrier();
    }
    var next = starts[local] - mine;
    for (var anchor = first; anchor < last; anchor++) {
        if visible[anchor] != 0u {
            list[1u + next] = anchor;
            next++;
        }
    }
    if local == LANES - 1u {
        list[0] = starts[local];
    }
}
