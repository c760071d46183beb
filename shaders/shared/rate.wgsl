#define_import_path tcgs::rate

// Shared by `rate` and `refresh_quant_steps`: their settings, and the decoding of a network's step adjustment.
#import tcgs::finite::below
#import tcgs::quantize::{Quantization, ROUNDED}

// Largest |log2(step / base step)|.
const STEP_OCTAVES: f32 = 3.5;

// Octaves from one coded standard deviation, or step, to the next.
const SPACING: f32 = 0.21875;

// Values, means and logarithms of larger magnitude count as not finite.
const LIMIT: f32 = 1e15;

// Groups of attributes: features, scalings, offsets.
const GROUPS: u32 = 3u;

// Of one group.
struct Settings {
    quantization: Quantization,
    // first column in a row, channels, place among the groups, first row of outputs
    group: vec4u,
    // column capacity of the outputs, of the bits, unused, unused
    room: vec4u,
    // weight of a bit, of the rendering gradient by a log step, unused, unused
    weights: vec4f,
}

struct Adjustment {
    // The network's output, and whether it is finite.
    wanted: f32,
    is_number: bool,
    // Base-2 logarithm of the step over the base step; when rounding, a multiple of the spacing.
    octaves: f32,
    // Which multiple; 0 if not rounding.
    index: i32,
}

fn is_number(value: f32) -> bool {
    return below(value, LIMIT);
}

// Octaves as a multiple of the spacing, in the decoder's integer arithmetic.
fn spacings(octaves: f32) -> i32 {
    return (i32(floor(octaves * 256.0 + 0.5)) * 1170 + 32768) >> 16u;
}

fn adjustment_of(wanted: f32, phase: u32) -> Adjustment {
    let is_wanted = is_number(wanted);
    var octaves = clamp(select(0.0, wanted, is_wanted), -STEP_OCTAVES, STEP_OCTAVES);
    var index = 0;
    if phase == ROUNDED {
        index = clamp(spacings(octaves), -16, 16);
        octaves = f32(index) * SPACING;
    }
    return Adjustment(wanted, is_wanted, octaves, index);
}
