// Finds where each tile's list begins and ends (the ranges start zeroed), and names its Gaussians.

#import tcgs::view::{INTERSECTIONS, View}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> slot_ids: array<u32>;
@group(0) @binding(5) var<storage, read_write> list: array<u32>;
@group(0) @binding(6) var<storage, read_write> ranges: array<vec2u>;

@compute @workgroup_size(64)
fn tile_ranges(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
    let total = min(counters[INTERSECTIONS], view.intersection_capacity);
    for (var i = begin; i < total; i += groups.x * 64u) {
        list[i] = slot_ids[slots[i]];
        let tile = keys[i];
        if i == 0u || keys[max(i, 1u) - 1u] != tile {
            ranges[tile].x = i;
        }
        if i + 1u == total || keys[min(i + 1u, total - 1u)] != tile {
            ranges[tile].y = i + 1u;
        }
    }
}
