// The rows that are rendered: every value plus noise of its step's width, or the nearest multiple of its step
// (METHOD.md §4.2). Masked offsets are copied.
#import tcgs::model::{OFFSET_COLUMN, ROW, SCALING_COLUMN}
#import tcgs::quantise::{FIXED_NOISE, Quantisation, quantise, quantise_scaling, scaling_of, stream_of}

@group(0) @binding(0) var<uniform> settings: Quantisation;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> masks: array<u32>;
@group(0) @binding(3) var<storage, read> steps: array<f32>;
@group(0) @binding(4) var<storage, read_write> rendered: array<f32>;

@compute @workgroup_size(64)
fn quantise_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = (group.x + group.y * 65535u) * 64u + local;
    if i >= settings.shape.x * ROW {
        return;
    }
    let anchor = i / ROW;
    let column = i - anchor * ROW;
    let value = rows[i];
    let place = u32(column >= SCALING_COLUMN) + u32(column >= OFFSET_COLUMN);
    let phase = settings.shape.y;
    var width = settings.base[place];
    if phase != FIXED_NOISE {
        width = steps[3u * anchor + place];
    }
    let stream = stream_of(settings.shape.z, anchor);
    var result = value;
    if place == 1u {
        result = log(quantise_scaling(phase, stream, column, scaling_of(value), width).value);
    } else if place == 0u || ((masks[anchor] >> ((column - OFFSET_COLUMN) / 3u)) & 1u) == 1u {
        result = quantise(phase, stream, column, value, width).value;
    }
    rendered[i] = result;
}
