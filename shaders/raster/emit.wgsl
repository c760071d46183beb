// Writes one (tile, slot) pair for each tile that a visible Gaussian touches, nearest Gaussian first. Counts the passes
// whose pairs all fitted, up to the first that overflowed, and records the capacity that one required.

#import tcgs::view::{INTERSECTIONS, REQUIRED, COMPLETED, VISIBLE, View}
#import tcgs::splat::{NONE, ridges_of, tile_bounds, touches_tile}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> counters: array<u32>;
@group(0) @binding(2) var<storage, read> ids: array<u32>;
// The first slot of each visible Gaussian: prefix sums of the tiles that they touch.
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> slots: array<u32>;
@group(0) @binding(7) var<storage, read_write> slot_ids: array<u32>;
@group(0) @binding(8) var<storage, read_write> first_slots: array<u32>;

fn put(slot: u32, tile: u32, id: u32) {
    keys[slot] = tile;
    slots[slot] = slot;
    slot_ids[slot] = id;
}

@compute @workgroup_size(64)
fn emit(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
    let all = counters[INTERSECTIONS];
    if begin == 0u && counters[REQUIRED] == 0u {
        if all > view.intersection_capacity {
            counters[REQUIRED] = all;
        } else {
            counters[COMPLETED] += 1u;
        }
    }
    let total = min(counters[VISIBLE], view.gaussian_capacity);
    for (var i = begin; i < total; i += groups.x * 64u) {
        let gaussian = ids[i];
        let place = splats[3u * gaussian];
        let conic = splats[3u * gaussian + 1u];
        let extent = vec2f(conic.w, splats[3u * gaussian + 2u].w);
        var slot = starts[i];
        first_slots[gaussian] = slot;
        // Writes exactly as many slots as `project` counted, even if this kernel rounds differently.
        var next = all;
        if i + 1u < total {
            next = starts[i + 1u];
        }
        let end = slot + min(next - slot, view.intersection_capacity - min(slot, view.intersection_capacity));
        let ridges = ridges_of(conic.xyz);
        let bounds = tile_bounds(place.xy, extent, view.tiles);
        for (var y = bounds.y; y < bounds.w; y++) {
            for (var x = bounds.x; x < bounds.z; x++) {
                if slot < end && touches_tile(place, conic.xyz, ridges, vec2u(x, y)) {
                    put(slot, y * view.tiles.x + x, gaussian);
                    slot += 1u;
                }
            }
        }
        for (; slot < end; slot++) {
            put(slot, 0u, NONE);
        }
    }
}
