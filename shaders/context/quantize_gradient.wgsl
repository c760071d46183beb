// From the gradients by the rendered rows, in place, to those by the rows, and to those by the base-2 logarithms of each
// anchor's three steps. Noise and rounding residuals are constants; so the gradient of a feature or an offset is
// that of its quantized value.
#import tcgs::index::lane_index
#import tcgs::model::{OFFSETS, OFFSET_COLUMN, ROW, SCALING_COLUMN}
#import tcgs::quantize::{FIXED_NOISE, Quantization, quantize, quantize_scaling, scaling_of, stream_of, through_floor}

const LOG_TWO: f32 = 0.69314718;

@group(0) @binding(0) var<uniform> settings: Quantization;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> masks: array<u32>;
@group(0) @binding(3) var<storage, read> steps: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_rows: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_log_steps: array<f32>;

@compute @workgroup_size(64)
fn quantize_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let anchor = lane_index(group, local);
    if anchor >= settings.shape.x {
        return;
    }
    let phase = settings.shape.y;
    var widths = settings.base.xyz;
    if phase != FIXED_NOISE {
        widths = vec3f(steps[3u * anchor], steps[3u * anchor + 1u], steps[3u * anchor + 2u]);
    }
    let stream = stream_of(settings.shape.z, anchor);
    let first = anchor * ROW;
    var sums = vec3f(0.0);
    for (var column = 0u; column < SCALING_COLUMN; column++) {
        let by_width = quantize(phase, stream, column, rows[first + column], widths.x).by_width;
        sums.x += d_rows[first + column] * by_width;
    }
    for (var column = SCALING_COLUMN; column < OFFSET_COLUMN; column++) {
        let scaling = scaling_of(rows[first + column]);
        let quantized = quantize_scaling(phase, stream, column, scaling, widths.y);
        let gradient = d_rows[first + column] / quantized.value;
        sums.y += gradient * quantized.by_width;
        d_rows[first + column] = through_floor(scaling, widths.y, gradient) * scaling;
    }
    let mask = masks[anchor];
    for (var k = 0u; k < OFFSETS; k++) {
        if ((mask >> k) & 1u) == 0u {
            continue;
        }
        for (var axis = 0u; axis < 3u; axis++) {
            let column = OFFSET_COLUMN + 3u * k + axis;
            let by_width = quantize(phase, stream, column, rows[first + column], widths.z).by_width;
            sums.z += d_rows[first + column] * by_width;
        }
    }
    sums *= LOG_TWO * widths;
    d_log_steps[3u * anchor] = sums.x;
    d_log_steps[3u * anchor + 1u] = sums.y;
    d_log_steps[3u * anchor + 2u] = sums.z;
}
