#define_import_path tcgs::ssim

// The 11-tap Gaussian window of SSIM, sigma 1.5, normalized (METHOD.md §1.2); symmetric, center last.
const REACH: i32 = 5;
const TAPS: array<f32, 6> = array<f32, 6>(
    0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
);

// Pixels of a line that an invocation processes at a time.
const STRIDE: i32 = 4;

// Columns in a block of a field.
const BLOCK: u32 = 8u;

struct Image {
    // width, height, pixels in line per invocation (a multiple of STRIDE), partial losses
    size: vec4u,
    // weight of L1 a sample, weight of SSIM a sample, unused, unused
    weights: vec4f,
    // first channel and number of channels of this dispatch, which the fields have room for; unused, unused
    channels: vec4u,
}

// The part of a line of one channel that an invocation computes: `first` up to, not including, `last`.
struct Run {
    channel: u32,
    line: u32,
    first: i32,
    last: i32,
    // Index among the runs of all channels.
    share: u32,
}

// Runs in lines of `length` samples.
fn runs(image: Image, length: u32) -> u32 {
    return (length + image.size.z - 1u) / image.size.z;
}

// The run of an invocation: neighbors take neighboring lines. Past the last run the channel is 3.
fn run_of(image: Image, index: u32, lines: u32, length: u32) -> Run {
    let runs = runs(image, length);
    let row = index / lines;
    let place = row / runs;
    let channel = select(3u, image.channels.x + place, place < image.channels.y);
    let first = (row - place * runs) * image.size.z;
    let share = image.channels.x * lines * runs + index;
    return Run(channel, index - row * lines, i32(first), i32(min(first + image.size.z, length)), share);
}

// Four samples in line, of which the first is `at`.
fn four(at: i32) -> vec4i {
    return at + vec4i(0, 1, 2, 3);
}

fn inside(at: vec4i, length: u32) -> vec4<bool> {
    return at >= vec4i(0) & at < vec4i(i32(length));
}

fn held(at: vec4i, length: u32) -> vec4u {
    return vec4u(clamp(at, vec4i(0), vec4i(i32(length) - 1)));
}

// Address of a field's sample of row 0. Rows follow one another within blocks of columns, so that a walk along a column is
// contiguous in memory and neighboring columns stay close. Rows are BLOCK apart; their number is a multiple of STRIDE.
fn places(image: Image, channel: u32, columns: vec4u) -> vec4u {
    let blocks = (image.size.x + BLOCK - 1u) / BLOCK;
    let rows = (image.size.y + 3u) / 4u * 4u;
    return ((channel - image.channels.x) * blocks + columns / BLOCK) * rows * BLOCK + columns % BLOCK;
}

// The last ten samples of a line.
struct Tail {
    a: vec4f,
    b: vec4f,
    c: vec2f,
}

// Takes the next four samples of a line and gives the windowed sums around the four that lie REACH before them. Equal taps
// share a product.
fn slide(tail: ptr<function, Tail>, next: vec4f) -> vec4f {
    let a = (*tail).a;
    let b = (*tail).b;
    let c = vec4f((*tail).c, next.xy);
    let d = next.zw;
    *tail = Tail(b, c, d);
    return TAPS[0] * (a + vec4f(c.zw, d))
        + TAPS[1] * (vec4f(a.yzw, b.x) + vec4f(c.yzw, d.x))
        + TAPS[2] * (vec4f(a.zw, b.xy) + c)
        + TAPS[3] * (vec4f(a.w, b.xyz) + vec4f(b.w, c.xyz))
        + TAPS[4] * (b + vec4f(b.zw, c.xy))
        + TAPS[5] * vec4f(b.yzw, c.x);
}

// One channel of packed 8-bit colors.
fn unpack(packed: vec4u, channel: u32) -> vec4f {
    return vec4f((packed >> vec4u(8u * channel)) & vec4u(255u)) / 255.0;
}

// Whether pixels count, by the weight in the fourth byte of their words: 255 or 0. Those that do not are as pixels outside the image.
// Without masks all count.
fn counted(packed: vec4u) -> vec4<bool> {
#ifdef MASKED
    return packed >= vec4u(0xff000000u);
#else
    return vec4<bool>(true, true, true, true);
#endif
}

fn total(values: vec4f) -> f32 {
    return values.x + values.y + values.z + values.w;
}

// Constants of SSIM (METHOD.md §1.2).
const LUMINANCE: f32 = 0.0001;
const CONTRAST: f32 = 0.0009;

// SSIM of four samples and its derivatives by E[x], E[x^2 + y^2] and E[(x - y)^2].
struct Similarity {
    ssim: vec4f,
    by_mean: vec4f,
    by_squares: vec4f,
    by_difference: vec4f,
}

// Both factors of SSIM as one minus what the images differ by: twice the covariance is the sum of the variances less the variance
// of the difference. Where images are flat, variances are differences of nearly equal numbers and wrong by a part in 3000 of
// CONTRAST; so is a covariance, and a ratio of the two. Here that touches only a term that vanishes with the difference.
fn similarity(x: vec4f, y: vec4f, squares: vec4f, difference: vec4f) -> Similarity {
    let m = x - y;
    let b1 = x * x + y * y + LUMINANCE;
    let b2 = squares - x * x - y * y + CONTRAST;
    let spread = difference - m * m;
    let luminance = 1.0 - m * m / b1;
    let structure = 1.0 - spread / b2;
    let by_difference = -luminance / b2;
    let by_squares = -by_difference * spread / b2;
    let by_mean = 2.0 * structure * m / b1 * (m * x / b1 - 1.0) - 2.0 * (m * by_difference + x * by_squares);
    return Similarity(luminance * structure, by_mean, by_squares, by_difference);
}
