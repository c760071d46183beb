#define_import_path tcgs::quantize

// Quantization of rows in training. Scalings are quantized themselves, not the logarithms that rows hold, and are at least
// one step, as in a file.

// Noise with the base steps, noise with each anchor's steps, the nearest multiples of each anchor's steps.
const FIXED_NOISE: u32 = 0u;
const NOISE: u32 = 1u;
const ROUNDED: u32 = 2u;

// Log-scalings are clamped to this magnitude, so that every scaling is a normal number.
const LARGEST_LOG: f32 = 80.0;

struct Quantization {
    // anchors, phase, key of the noise, unused
    shape: vec4u,
    // base steps of features, scalings, offsets, unused
    base: vec4f,
}

struct Quantized {
    value: f32,
    // The value's derivative by the step.
    by_width: f32,
}

// The hash of PCG: one round and its permutation.
fn pcg_hash(value: u32) -> u32 {
    let state = value * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (word >> 22u) ^ word;
}

// Start of an anchor's noise sequence.
fn stream_of(key: u32, anchor: u32) -> u32 {
    return pcg_hash(pcg_hash(anchor) ^ key);
}

// Uniform in (-1/2, 1/2), exact in f32, a function of key, anchor and column alone.
fn noise(stream: u32, column: u32) -> f32 {
    return (f32(pcg_hash(stream + column) >> 9u) + 0.5) / 8388608.0 - 0.5;
}

fn quantize(phase: u32, stream: u32, column: u32, value: f32, width: f32) -> Quantized {
    if phase == ROUNDED {
        let steps = value / width;
        let nearest = round(steps);
        return Quantized(nearest * width, nearest - steps);
    }
    let added = noise(stream, column);
    return Quantized(value + added * width, added);
}

fn scaling_of(log_scaling: f32) -> f32 {
    return exp(clamp(log_scaling, -LARGEST_LOG, LARGEST_LOG));
}

// A scaling below one step counts as one step, so it grows with the step and not with itself.
fn quantize_scaling(phase: u32, stream: u32, column: u32, scaling: f32, width: f32) -> Quantized {
    var result = quantize(phase, stream, column, max(scaling, width), width);
    if scaling < width {
        result.by_width += 1.0;
    }
    return result;
}

// The gradient by a scaling from that by its quantized value: below one step, only what increases the scaling passes.
fn through_floor(scaling: f32, width: f32, gradient: f32) -> f32 {
    return select(gradient, min(gradient, 0.0), scaling < width);
}
