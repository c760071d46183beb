#define_import_path tcgs::ssim

// The 11-tap Gaussian window of SSIM, sigma 1.5, normalised (method.md section 1.5); symmetric, centre last.
const REACH: i32 = 5;
const TAPS: array<f32, 6> = array<f32, 6>(
    0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
);

// Pixels in line that an invocation makes: their windows overlap, so that 18 reads serve eight windows of 11.
const RUN: u32 = 8u;

struct Image {
    // width, height, unused, unused
    size: vec4u,
    // weight of L1 a sample, weight of SSIM a sample, unused, unused
    weights: vec4f,
}

// The samples in line that the windows of a run reach: its eight and REACH on either side.
struct Line {
    a: vec4f,
    b: vec4f,
    c: vec4f,
    d: vec4f,
    e: vec2f,
}

// The windowed sums of a run's first and last four pixels.
struct Windows {
    low: vec4f,
    high: vec4f,
}

fn times(left: Line, right: Line) -> Line {
    return Line(left.a * right.a, left.b * right.b, left.c * right.c, left.d * right.d, left.e * right.e);
}

fn plus(left: Line, right: Line) -> Line {
    return Line(left.a + right.a, left.b + right.b, left.c + right.c, left.d + right.d, left.e + right.e);
}

// Four neighbouring windows over 14 samples; equal taps share a product.
fn four_windows(a: vec4f, b: vec4f, c: vec4f, d: vec2f) -> vec4f {
    return TAPS[0] * (a + vec4f(c.zw, d))
        + TAPS[1] * (vec4f(a.yzw, b.x) + vec4f(c.yzw, d.x))
        + TAPS[2] * (vec4f(a.zw, b.xy) + c)
        + TAPS[3] * (vec4f(a.w, b.xyz) + vec4f(b.w, c.xyz))
        + TAPS[4] * (b + vec4f(b.zw, c.xy))
        + TAPS[5] * vec4f(b.yzw, c.x);
}

fn windows(line: Line) -> Windows {
    return Windows(
        four_windows(line.a, line.b, line.c, line.d.xy),
        four_windows(line.b, line.c, line.d, line.e),
    );
}

// One channel of packed 8-bit colours.
fn unpack(packed: vec4u, channel: u32) -> vec4f {
    return vec4f((packed >> vec4u(8u * channel)) & vec4u(255u)) / 255.0;
}
