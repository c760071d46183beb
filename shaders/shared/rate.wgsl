#define_import_path tcgs::rate

// What `rate` and `refresh_steps` share: their settings, and how a network's step adjustment is read.
#import tcgs::finite::below
#import tcgs::quantise::{Quantisation, ROUNDED}

// Octaves by which a step may differ from its base step.
const STEP_OCTAVES: f32 = 3.5;

// Octaves from one coded standard deviation, or step, to the next.
const SPACING: f32 = 0.21875;

// Values, means and logarithms from here on count as numbers that are none.
const LIMIT: f32 = 1e15;

struct Settings {
    quantisation: Quantisation,
    // first column in a row, channels, place among the groups, first row of outputs
    group: vec4u,
    // columns that the outputs have room for, that the bits have, unused, unused
    room: vec4u,
    // of a bit, of rendering's gradient by a log step, unused, unused
    weights: vec4f,
}

struct Adjustment {
    // What the network says, and whether it is a number.
    wanted: f32,
    is_number: bool,
    // Octaves of base steps that the step is; when rounding, a multiple of the spacing.
    octaves: f32,
    // Which multiple; 0 if not rounding.
    index: i32,
}

fn is_number(value: f32) -> bool {
    return below(value, LIMIT);
}

// The multiple of the spacing that the decoder's integers make of octaves.
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
