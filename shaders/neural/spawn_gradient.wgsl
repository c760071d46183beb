// Gradients of `spawn_gaussians`: from the Gaussians back to the networks' outputs, the offsets and the log-scalings,
// with the volume regularizer (weight times the mean product of scales over visible Gaussians) added. The gradients by the
// outputs overwrite the outputs.
#import tcgs::anchor_view::View
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::model::{ROW, OFFSETS, SCALING_COLUMN, OFFSET_COLUMN, COVARIANCE_OUT, COLOR_OUT, logistic}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> columns: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read> rows: array<f32>;
@group(0) @binding(4) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(5) var<storage, read> d_geometry: array<vec4f>;
@group(0) @binding(6) var<storage, read> d_colors: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> outputs: array<f32>;
@group(0) @binding(8) var<storage, read_write> d_rows: array<f32>;

@compute @workgroup_size(64)
fn spawn_gradient(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let column = part_of(group, groups) * 64u + local;
    if column >= columns[0] {
        return;
    }
    let capacity = view.counts.y;
    let index = columns[1u + column];
    let anchor = columns[1u + capacity + column];
    let gaussians = capacity * OFFSETS;
    let row = anchor * ROW;
    let s = row + SCALING_COLUMN;
    let reach = exp(vec3f(rows[s], rows[s + 1u], rows[s + 2u]));
    let size = exp(vec3f(rows[s + 3u], rows[s + 4u], rows[s + 5u]));
    // image.w carries the regularizer's weight.
    let volume_weight = view.image.w / max(f32(counts[1]), 1.0);
    var d_reach = vec3f(0.0);
    var d_size = vec3f(0.0);
    // As in `spawn_gaussians`, a loop over the living alone.
    var living = 0u;
    for (var k = 0u; k < OFFSETS; k++) {
        if geometry[index * OFFSETS + k].w > 0.0 {
            living |= 1u << k;
            continue;
        }
        outputs[k * capacity + column] = 0.0;
        let c = (COVARIANCE_OUT + 7u * k) * capacity + column;
        for (var i = 0u; i < 7u; i++) {
            outputs[c + i * capacity] = 0.0;
        }
        let rgb = (COLOR_OUT + 3u * k) * capacity + column;
        for (var i = 0u; i < 3u; i++) {
            outputs[rgb + i * capacity] = 0.0;
        }
    }
    while living != 0u {
        let k = firstTrailingBit(living);
        living &= living - 1u;
        let gaussian = index * OFFSETS + k;
        let c = (COVARIANCE_OUT + 7u * k) * capacity + column;
        let rgb = (COLOR_OUT + 3u * k) * capacity + column;
        let o = row + OFFSET_COLUMN + 3u * k;
        let opacity = geometry[gaussian].w;
        let d = d_geometry[gaussian];
        let offset = vec3f(rows[o], rows[o + 1u], rows[o + 2u]);
        let d_offset = d.xyz * reach;
        d_rows[o] = d_offset.x;
        d_rows[o + 1u] = d_offset.y;
        d_rows[o + 2u] = d_offset.z;
        d_reach += d.xyz * offset;
        outputs[k * capacity + column] = d.w * (1.0 - opacity * opacity);

        let shape = vec3f(
            logistic(outputs[c]),
            logistic(outputs[c + capacity]),
            logistic(outputs[c + 2u * capacity]),
        );
        let scale = size * shape;
        let d_scale = d_geometry[scale_row(gaussians, gaussian)].xyz + volume_weight * scale.yzx * scale.zxy;
        d_size += d_scale * shape;
        let d_shape = d_scale * size * shape * (1.0 - shape);
        outputs[c] = d_shape.x;
        outputs[c + capacity] = d_shape.y;
        outputs[c + 2u * capacity] = d_shape.z;
        let d_quat = d_geometry[quat_row(gaussians, gaussian)];
        outputs[c + 3u * capacity] = d_quat.x;
        outputs[c + 4u * capacity] = d_quat.y;
        outputs[c + 5u * capacity] = d_quat.z;
        outputs[c + 6u * capacity] = d_quat.w;

        let color = vec3f(
            logistic(outputs[rgb]),
            logistic(outputs[rgb + capacity]),
            logistic(outputs[rgb + 2u * capacity]),
        );
        let d_color = d_colors[gaussian].xyz * color * (1.0 - color);
        outputs[rgb] = d_color.x;
        outputs[rgb + capacity] = d_color.y;
        outputs[rgb + 2u * capacity] = d_color.z;
    }
    let d_log_reach = d_reach * reach;
    let d_log_size = d_size * size;
    d_rows[s] = d_log_reach.x;
    d_rows[s + 1u] = d_log_reach.y;
    d_rows[s + 2u] = d_log_reach.z;
    d_rows[s + 3u] = d_log_size.x;
    d_rows[s + 4u] = d_log_size.y;
    d_rows[s + 5u] = d_log_size.z;
}
