// The rows that are rendered: every value plus noise of its step's width, or the nearest multiple of its step
// (METHOD.md §4.2). Masked offsets are copied.
#import tcgs::index::lane_index
#import tcgs::model::{OFFSET_COLUMN, ROW, SCALING_COLUMN}
#import tcgs::quantize::{FIXED_NOISE, Quantization, quantize, quantize_scaling, scaling_of, stream_of}

@group(0) @binding(0) var<uniform> settings: Quantization;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> masks: array<u32>;
@group(0) @binding(3) var<storage, read> steps: array<f32>;
@group(0) @binding(4) var<storage, read_write> rendered: array<f32>;

// Values that an invocation quantizes. On a software adapter it is a whole row: lanes with different groups of columns would each
// compute what every group needs.
#ifdef SOFTWARE
const RUN: u32 = ROW;
#else
const RUN: u32 = 1u;
#endif

@compute @workgroup_size(64)
fn quantize_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let begin = (lane_index(group, local)) * RUN;
    if begin >= settings.shape.x * ROW {
        return;
    }
    let anchor = begin / ROW;
    let phase = settings.shape.y;
    var widths = settings.base.xyz;
    if phase != FIXED_NOISE {
        widths = vec3f(steps[3u * anchor], steps[3u * anchor + 1u], steps[3u * anchor + 2u]);
    }
    let stream = stream_of(settings.shape.z, anchor);
    let mask = masks[anchor];
#ifdef SOFTWARE
    for (var column = 0u; column < SCALING_COLUMN; column++) {
        rendered[begin + column] = quantize(phase, stream, column, rows[begin + column], widths.x).value;
    }
    for (var column = SCALING_COLUMN; column < OFFSET_COLUMN; column++) {
        let scaling = scaling_of(rows[begin + column]);
        rendered[begin + column] = log(quantize_scaling(phase, stream, column, scaling, widths.y).value);
    }
    for (var column = OFFSET_COLUMN; column < ROW; column++) {
        let value = rows[begin + column];
        let quantized = quantize(phase, stream, column, value, widths.z).value;
        rendered[begin + column] = select(value, quantized, ((mask >> ((column - OFFSET_COLUMN) / 3u)) & 1u) == 1u);
    }
#else
    let column = begin - anchor * ROW;
    let place = u32(column >= SCALING_COLUMN) + u32(column >= OFFSET_COLUMN);
    let value = rows[begin];
    let width = widths[place];
    var result = value;
    if place == 1u {
        result = log(quantize_scaling(phase, stream, column, scaling_of(value), width).value);
    } else if place == 0u || ((mask >> ((column - OFFSET_COLUMN) / 3u)) & 1u) == 1u {
        result = quantize(phase, stream, column, value, width).value;
    }
    rendered[begin] = result;
#endif
}
