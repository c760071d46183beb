// Lists the visible Gaussians with their depths, in index order.

#import tcgs::view::View
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> count: array<u32>;
@group(0) @binding(2) var<storage, read> visible: array<u32>;
@group(0) @binding(3) var<storage, read> places: array<u32>;
@group(0) @binding(4) var<storage, read> depths: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> ids: array<u32>;

@compute @workgroup_size(64)
fn compact(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
    let total = min(count[0], view.gaussian_capacity);
    for (var i = begin; i < total; i += groups.x * 64u) {
        if visible[i] != 0u {
            keys[places[i]] = depths[i];
            ids[places[i]] = i;
        }
    }
}
