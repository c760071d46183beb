#define_import_path tcgs::model

// Columns of an anchor's row of parameters: feature, six log-scalings, three coordinates an offset.
const FEATURES: u32 = #{FEATURES}u;
const OFFSETS: u32 = #{OFFSETS}u;
const SCALING_COLUMN: u32 = FEATURES;
const OFFSET_COLUMN: u32 = FEATURES + 6u;
const ROW: u32 = FEATURES + 6u + 3u * OFFSETS;

// Rows of the networks' output: opacities, then seven covariance values an offset, then three color values an offset.
const COVARIANCE_OUT: u32 = OFFSETS;
const COLOR_OUT: u32 = 8u * OFFSETS;

// Larger magnitudes count as infinite, since their products overflow.
const LIMIT: f32 = 1e30;

// WGSL leaves tanh undefined where its exponential overflows, and some devices return NaN. From 10 on it is 1 in f32.
fn tanh_bounded(x: f32) -> f32 {
    return tanh(clamp(x, -10.0, 10.0));
}

fn logistic(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-x));
}
