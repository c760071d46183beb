// The tile counts of the visible Gaussians, nearest first.

#import tcgs::view::{VISIBLE, View}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> ids: array<u32>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_tiles: array<u32>;

@compute @workgroup_size(64)
fn tile_counts(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
    let total = min(counters[VISIBLE], view.gaussian_capacity);
    for (var i = begin; i < total; i += groups.x * 64u) {
        sorted_tiles[i] = tiles[ids[i]];
    }
}
