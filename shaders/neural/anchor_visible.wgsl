// Flags the anchors that may reach the image: each is projected as an axis-aligned Gaussian of its offset scale
// (METHOD.md §2.3), and the three-sigma box of the projection must touch the image.
#import tcgs::anchor_view::{View, to_camera}
#import tcgs::index::lane_index
#import tcgs::model::{ROW, SCALING_COLUMN}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> positions: array<vec4f>;
@group(0) @binding(2) var<storage, read> rows: array<f32>;
@group(0) @binding(3) var<storage, read_write> visible: array<u32>;

@compute @workgroup_size(64)
fn anchor_visible(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let anchor = lane_index(group, local);
    if anchor >= view.counts.x {
        return;
    }
    let t = to_camera(view, positions[anchor].xyz);
    if !(t.z > view.image.z) {
        visible[anchor] = 0u;
        return;
    }
    let column = anchor * ROW + SCALING_COLUMN;
    let scale = exp(vec3f(rows[column], rows[column + 1u], rows[column + 2u]));
    let f = view.intrinsics.xy;
    let c = view.intrinsics.zw;
    let size = view.image.xy;
    let margin = 0.3 * 0.5 * size / f;
    let low = -c / f - margin;
    let high = (size - c) / f + margin;
    let slope = clamp(t.xy / t.z, low, high);
    // Rows of J R: the projection's gradient with respect to the world point.
    let gx = f.x / t.z * (view.row_x.xyz - slope.x * view.row_z.xyz) * scale;
    let gy = f.y / t.z * (view.row_y.xyz - slope.y * view.row_z.xyz) * scale;
    let radius = 3.0 * sqrt(vec2f(dot(gx, gx), dot(gy, gy)) + 0.3);
    let center = f * t.xy / t.z + c;
    let inside = all(center + radius > vec2f(0.0)) && all(center - radius < size);
    visible[anchor] = select(0u, 1u, inside);
}
