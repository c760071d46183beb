#define_import_path tcgs::gaussian

// Bits of a value coded in a bin of width `width` under a normal distribution, and their derivatives, in a form that stays
// accurate in the tails (the table of errors is in the crate tcgs-engine, train/context/rate.rs). The polynomials are the fits of
// tests/oracles/gaussian_fit.py.

const INVERSE_ROOT_TWO: f32 = 0.70710678;
const INVERSE_LOG_TWO: f32 = 1.44269504;
const INVERSE_ROOT_TWO_PI: f32 = 0.39894228;
const ROOT_TWO_OVER_PI: f32 = 0.79788456;

// Distances in standard deviations are clamped here, so that their squares stay finite.
const FAR: f32 = 1e15;

// exp(x^2) erfc(x) for x >= 0; relative error of the fit 5.2e-8.
fn scaled_erfc(x: f32) -> f32 {
    let s = (x - 2.5) / (x + 2.5);
    var p = fma(s, -6.1459703e-5, 0.000404894239);
    p = fma(s, p, 0.000457518104);
    p = fma(s, p, -0.00417894698);
    p = fma(s, p, 0.000951485736);
    p = fma(s, p, 0.0326766343);
    p = fma(s, p, -0.102972053);
    p = fma(s, p, 0.157644539);
    p = fma(s, p, -0.0990240825);
    p = fma(s, p, -0.122357482);
    p = fma(s, p, 1.26483818);
    return p / (1.0 + 2.0 * x);
}

// erf(x) for x >= 0; relative error of the fit 1.4e-9 up to a half, beyond it that of scaled_erfc.
fn error_function(x: f32) -> f32 {
    let t = x * x;
    if x > 0.5 {
        return 1.0 - exp(-min(t, 100.0)) * scaled_erfc(x);
    }
    var p = fma(t, 0.00471799007, -0.0267571847);
    p = fma(t, p, 0.112828228);
    p = fma(t, p, -0.376126086);
    p = fma(t, p, 1.12837917);
    return x * p;
}

// 1 - exp(-x) for x >= 0 without cancellation; relative error of the series 5e-8.
fn one_minus_exp(x: f32) -> f32 {
    if x > 0.25 {
        return 1.0 - exp(-min(x, 100.0));
    }
    let inner = 1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0));
    return x * (1.0 - x / 2.0 * (1.0 - x / 3.0 * inner));
}

// The integral of cosh(y v) exp(-h^2 v^2 / 2) over v from 0 to 1, for y below 1/2 and h below y / h: three nodes of the
// six-point Gauss-Legendre rule, error below 1e-9.
fn mean_density(y: f32, h: f32) -> f32 {
    let nodes = vec3f(0.23861919, 0.66120939, 0.93246951);
    let half = h * nodes;
    return dot(vec3f(0.46791393, 0.36076157, 0.17132449), cosh(y * nodes) * exp(-0.5 * half * half));
}

// Bits of `value` in a bin of `width` around it under a normal distribution of `mean` and `deviation`; then the bits'
// derivatives by the value (by the mean: its negative), by the base-2 logarithm of the deviation, and by that of the width.
//
// With d = |value - mean|, a = (d - width / 2) / deviation and b = (d + width / 2) / deviation, the probability is
// (erf(b / sqrt 2) - erf(a / sqrt 2)) / 2, whose terms cancel where a > 0. There it is
// exp(-a^2 / 2) (erfcx(a / sqrt 2) - exp(-2 y) erfcx(b / sqrt 2)) / 2 with y = d width / (2 deviation^2), which cancels only
// where y is small too, and then density and width give it: width / deviation phi(d / deviation) mean_density.
fn symbol_bits(value: f32, mean: f32, deviation: f32, width: f32) -> vec4f {
    let difference = value - mean;
    let d = abs(difference);
    let z = min(d / deviation, FAR);
    let w = clamp(width / deviation, 1e-30, FAR);
    let a = clamp((d - 0.5 * width) / deviation, -FAR, FAR);
    let b = min((d + 0.5 * width) / deviation, FAR);
    let y = 0.5 * z * w;
    let rest = exp(-min(2.0 * y, 100.0));
    var bits: f32;
    // The density at a over the probability; that at b is `rest` of it.
    var ratio: f32;
    if a <= 0.0 {
        let twice = error_function(b * INVERSE_ROOT_TWO) + error_function(-a * INVERSE_ROOT_TWO);
        let probability = clamp(0.5 * twice, 1e-37, 1.0);
        bits = -log2(probability);
        ratio = INVERSE_ROOT_TWO_PI * exp(-min(0.5 * a * a, 200.0)) / probability;
    } else if y < 0.5 {
        let density = w * mean_density(y, 0.5 * w);
        bits = 0.5 * INVERSE_LOG_TWO * z * z - log2(INVERSE_ROOT_TWO_PI * density);
        ratio = exp(y - 0.125 * w * w) / density;
    } else {
        let twice = scaled_erfc(a * INVERSE_ROOT_TWO) - rest * scaled_erfc(b * INVERSE_ROOT_TWO);
        bits = 0.5 * INVERSE_LOG_TWO * a * a - log2(0.5 * twice);
        ratio = ROOT_TWO_OVER_PI / twice;
    }
    let slope = ratio * one_minus_exp(2.0 * y);
    let spread = 0.5 * w * ratio * (1.0 + rest);
    return vec4f(bits, sign(difference) * INVERSE_LOG_TWO * slope / deviation, spread - z * slope, -spread);
}
