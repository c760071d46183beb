// Zeroes the gradients of the Gaussians that touch no tile; `project_backward` writes the others. Rows beyond the count are not
// written.

#import tcgs::view::View
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> count: array<u32>;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> d_geometry: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> d_colors: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> d_means_image: array<vec4f>;

@compute @workgroup_size(64)
fn clear_culled(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
    let total = min(count[0], view.gaussian_capacity);
    for (var i = begin; i < total; i += groups.x * 64u) {
        if tiles[i] == 0u {
            d_geometry[i] = vec4f(0.0);
            d_geometry[scale_row(view.gaussian_capacity, i)] = vec4f(0.0);
            d_geometry[quat_row(view.gaussian_capacity, i)] = vec4f(0.0);
            d_colors[i] = vec4f(0.0);
            d_means_image[i] = vec4f(0.0);
        }
    }
}
