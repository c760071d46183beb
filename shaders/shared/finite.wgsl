#define_import_path tcgs::finite

// Tests for NaN and infinity by their bits. A shader may be compiled as if neither existed, and a comparison that only they
// fail may be removed (fast math on Metal). Without the sign bit, the bits of floats order as their magnitudes, with infinity
// and then NaN last.

const NO_SIGN: u32 = 0x7fffffffu;
const INFINITY: u32 = 0x7f800000u;

fn finite(value: f32) -> bool {
    return (bitcast<u32>(value) & NO_SIGN) < INFINITY;
}

fn all_finite(values: vec4f) -> bool {
    return all((bitcast<vec4u>(values) & vec4u(NO_SIGN)) < vec4u(INFINITY));
}

// Whether the magnitude is below a finite positive limit; false for NaN.
fn below(value: f32, limit: f32) -> bool {
    return (bitcast<u32>(value) & NO_SIGN) < bitcast<u32>(limit);
}

fn each_below(values: vec4f, limit: f32) -> vec4<bool> {
    return (bitcast<vec4u>(values) & vec4u(NO_SIGN)) < vec4u(bitcast<u32>(limit));
}
