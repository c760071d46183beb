// Turns the networks' outputs into the Gaussians of a view (METHOD.md §2.3): Gaussian `index * OFFSETS + k` is
// offset k of the index-th visible anchor. Columns are those of opaque anchors alone; the others' rows stay as `opaque_anchors`
// left them. There is no Gaussian where the opacity is not positive or its output not finite, the mask is off, or position or
// size is not finite. Positions are relative to the view's `center`.
#import tcgs::anchor_view::View
#import tcgs::finite::{below, each_below, finite}
#import tcgs::geometry::{quat_row, scale_row}
#import tcgs::model::{ROW, OFFSETS, SCALING_COLUMN, OFFSET_COLUMN, COVARIANCE_OUT, COLOR_OUT, LIMIT, logistic, tanh_bounded}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> columns: array<u32>;
@group(0) @binding(2) var<storage, read> positions: array<vec4f>;
@group(0) @binding(3) var<storage, read> rows: array<f32>;
@group(0) @binding(4) var<storage, read> outputs: array<f32>;
@group(0) @binding(5) var<storage, read> masks: array<u32>;
@group(0) @binding(6) var<storage, read_write> geometry: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> alive: array<u32>;

@compute @workgroup_size(64)
fn spawn_gaussians(
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
    let position = positions[anchor].xyz - view.center.xyz;
    let s = row + SCALING_COLUMN;
    let reach = exp(vec3f(rows[s], rows[s + 1u], rows[s + 2u]));
    let size = exp(vec3f(rows[s + 3u], rows[s + 4u], rows[s + 5u]));
    // Of most anchors few offsets are opaque, and a loop over those alone is as long as the most that any lane has.
    var opaque = 0u;
    for (var k = 0u; k < OFFSETS; k++) {
        let output = outputs[k * capacity + column];
        if finite(output) && output > 0.0 {
            opaque |= 1u << k;
        }
    }
    opaque &= masks[anchor];
    var born = 0u;
    while opaque != 0u {
        let k = firstTrailingBit(opaque);
        opaque &= opaque - 1u;
        let gaussian = index * OFFSETS + k;
        let opacity = tanh_bounded(outputs[k * capacity + column]);
        let o = row + OFFSET_COLUMN + 3u * k;
        let mean = position + vec3f(rows[o], rows[o + 1u], rows[o + 2u]) * reach;
        if !(opacity > 0.0 && all(each_below(vec4f(mean, 0.0), LIMIT)) && below(size.x * size.y * size.z, LIMIT)) {
            continue;
        }
        born++;
        let c = (COVARIANCE_OUT + 7u * k) * capacity + column;
        let shape = vec3f(
            logistic(outputs[c]),
            logistic(outputs[c + capacity]),
            logistic(outputs[c + 2u * capacity]),
        );
        let rgb = (COLOR_OUT + 3u * k) * capacity + column;
        geometry[gaussian] = vec4f(mean, opacity);
        geometry[scale_row(gaussians, gaussian)] = vec4f(size * shape, 0.0);
        geometry[quat_row(gaussians, gaussian)] = vec4f(
            outputs[c + 3u * capacity],
            outputs[c + 4u * capacity],
            outputs[c + 5u * capacity],
            outputs[c + 6u * capacity],
        );
        colors[gaussian] = vec4f(
            logistic(outputs[rgb]),
            logistic(outputs[rgb + capacity]),
            logistic(outputs[rgb + 2u * capacity]),
            0.0,
        );
    }
    alive[index] = born;
}
