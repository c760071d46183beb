// The rate of the attribute groups of the sampled anchors: bits of each quantized value under the distribution that the
// group's network predicts, with gradients by the network's outputs (stored) and by the rows (added to what is there).
// Everything is in units of steps, so that a rounded value is its symbol.
//
// One group of one sampled anchor an invocation. Values that are not finite have no bits and no gradient.
#import tcgs::gaussian::symbol_bits
#import tcgs::index::group_index
#import tcgs::model::ROW
#import tcgs::quantize::{Quantized, ROUNDED, quantize, quantize_scaling, scaling_of, stream_of, through_floor}
#import tcgs::rate::{GROUPS, SPACING, STEP_OCTAVES, Settings, adjustment_of, is_number, spacings}

const LOG_TWO: f32 = 0.69314718;

// The coded standard deviations: the finest in octaves of steps, and the last.
const FINEST: f32 = -3.5;
const LAST: i32 = 63;

// Bits of an escape, beside twice the logarithm of its distance.
const ESCAPE_BITS: f32 = 26.0;

// Bound of a value's derivatives, in steps and octaves, so that one outlier cannot dominate.
const STEEPEST: f32 = 1e4;

@group(0) @binding(0) var<uniform> groups: array<Settings, GROUPS>;
// How many anchors are sampled, then which.
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> rows: array<f32>;
@group(0) @binding(3) var<storage, read> masks: array<u32>;
// Column-major: a mean a channel in base steps, a log deviation a channel in octaves of base steps, a step adjustment.
@group(0) @binding(4) var<storage, read> outputs: array<f32>;
@group(0) @binding(5) var<storage, read> d_log_steps: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_outputs: array<f32>;
@group(0) @binding(7) var<storage, read_write> d_rows: array<f32>;
// Column-major: bits in a file for the three groups, where outliers are escapes, then each offset's bits.
@group(0) @binding(8) var<storage, read_write> bits: array<f32>;

@compute @workgroup_size(64)
fn rate(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let block = group_index(group);
    let settings = groups[block % GROUPS];
    let sampled = block / GROUPS * 64u + local;
    if sampled >= list[0] {
        return;
    }
    let anchor = list[1u + sampled];
    let channels = settings.group.y;
    let place = settings.group.z;
    let room = settings.room.x;
    let output = settings.group.w * room + sampled;
    let phase = settings.quantization.shape.y;
    let stream = stream_of(settings.quantization.shape.z, anchor);
    let mask = masks[anchor];
    let weight = settings.weights.x;

    let adjustment = adjustment_of(outputs[output + 2u * channels * room], phase);
    let adjusts = adjustment.is_number;
    let octaves = adjustment.octaves;
    let base_width = settings.quantization.base[place];
    let in_base = exp2(octaves);
    let width = base_width * in_base;

    var sum = 0.0;
    var by_octaves = 0.0;
    var of_offset = 0.0;
    for (var channel = 0u; channel < channels; channel++) {
        let k = channel / 3u;
        let is_kept = place != 2u || ((mask >> k) & 1u) == 1u;
        let column = settings.group.x + channel;
        let mean_at = output + channel * room;
        let scale_at = output + (channels + channel) * room;
        var by_mean = 0.0;
        var by_scale = 0.0;
        var cost = 0.0;
        let row_value = rows[anchor * ROW + column];
        let mean = outputs[mean_at] / in_base;
        let scale = outputs[scale_at];
        var value = row_value;
        var quantized: Quantized;
        if place == 1u {
            value = scaling_of(row_value);
            quantized = quantize_scaling(phase, stream, column, value, width);
        } else {
            quantized = quantize(phase, stream, column, value, width);
        }
        let symbol = quantized.value / width;
        if is_kept && adjusts && is_number(row_value) && is_number(symbol) && is_number(mean) && is_number(scale) {
            // Octaves of steps, clamped to the decoder's range.
            let bounded = clamp(scale - octaves, FINEST, FINEST + f32(LAST) * SPACING);
            var coded = bounded;
            var center = mean;
            if phase == ROUNDED {
                let bounded_scale = clamp(scale, -100.0, 100.0);
                coded = FINEST + SPACING * f32(clamp(spacings(bounded_scale) + 16 - adjustment.index, 0, LAST));
                center = floor(16.0 * mean + 0.5) / 16.0;
            }
            let found = symbol_bits(symbol, center, exp2(coded), 1.0);
            cost = found.x;
            sum += min(cost, ESCAPE_BITS + 2.0 * log2(1.0 + abs(symbol - center)));
            let by_value = clamp(found.y, -STEEPEST, STEEPEST);
            let by_coded = clamp(found.z, -STEEPEST, STEEPEST);
            by_mean = -by_value / in_base;
            var by_adjustment = -LOG_TWO * by_value * (symbol - quantized.by_width - center);
            // Outside the bounds, only gradients that lead back inside pass.
            if bounded == scale - octaves {
                by_scale = by_coded;
                by_adjustment -= by_coded;
            } else if bounded > scale - octaves {
                by_scale = min(by_coded, 0.0);
            } else {
                by_scale = max(by_coded, 0.0);
            }
            by_octaves += clamp(by_adjustment, -STEEPEST, STEEPEST);
            var by_row = by_value / width;
            if place == 1u {
                by_row = through_floor(value, width, by_row) * value;
            }
            d_rows[anchor * ROW + column] += weight * by_row;
        }
        d_outputs[mean_at] = weight * by_mean;
        d_outputs[scale_at] = weight * by_scale;
        if place == 2u {
            of_offset += cost;
            if channel == 3u * k + 2u {
                bits[(3u + k) * settings.room.y + sampled] = of_offset;
                of_offset = 0.0;
            }
        }
    }
    bits[place * settings.room.y + sampled] = sum;
    let rendered = d_log_steps[3u * anchor + place];
    var d_wanted = weight * by_octaves;
    if is_number(rendered) {
        d_wanted += settings.weights.y * rendered;
    }
    let is_free = adjusts && abs(adjustment.wanted) <= STEP_OCTAVES;
    d_outputs[output + 2u * channels * room] = select(0.0, d_wanted, is_free);
}
