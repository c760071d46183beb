// The colors of a render as the correction of its photograph makes them: A c + b (METHOD.md §2.11). A correction is three rows, each a
// row of A and then the component of b.
#import tcgs::index::lane_index

@group(0) @binding(0) var<uniform> pixels_and_photograph: vec4u;
@group(0) @binding(1) var<storage, read> rows: array<vec4f>;
@group(0) @binding(2) var<storage, read> render: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> corrected: array<vec4f>;

@compute @workgroup_size(64)
fn correct_colors(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = lane_index(group, local);
    if pixel >= pixels_and_photograph.x {
        return;
    }
    let row = 3u * pixels_and_photograph.y;
    let color = vec4f(render[pixel].xyz, 1.0);
    corrected[pixel] = vec4f(dot(rows[row], color), dot(rows[row + 1u], color), dot(rows[row + 2u], color), 0.0);
}
