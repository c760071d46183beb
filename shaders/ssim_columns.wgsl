// Second half of SSIM's window, along columns, and the SSIM map with its derivatives by E[x], E[x^2] and E[xy], in
// planes as the moments. Also each pixel's share of the losses: SSIM, L1 and squared error, each summed over the three
// channels.
#import tcgs::ssim::{Image, Line, Windows, REACH, RUN, unpack, windows}

const LUMINANCE: f32 = 0.0001;
const CONTRAST: f32 = 0.0009;

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<f32>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read> moments: array<f32>;
@group(0) @binding(4) var<storage, read_write> derivatives: array<f32>;
@group(0) @binding(5) var<storage, read_write> losses: array<vec4f>;

// Outside the image there is zero.
fn sample(plane: u32, row: i32, column: u32) -> f32 {
    let height = i32(image.size.y);
    let at = (plane * image.size.y + u32(clamp(row, 0, height - 1))) * image.size.x + column;
    return select(0.0, moments[at], row >= 0 && row < height);
}

fn samples(plane: u32, row: i32, column: u32) -> vec4f {
    return vec4f(
        sample(plane, row, column),
        sample(plane, row + 1, column),
        sample(plane, row + 2, column),
        sample(plane, row + 3, column),
    );
}

fn moment(plane: u32, row: i32, column: u32) -> Windows {
    return windows(Line(
        samples(plane, row, column),
        samples(plane, row + 4, column),
        samples(plane, row + 8, column),
        samples(plane, row + 12, column),
        vec2f(sample(plane, row + 16, column), sample(plane, row + 17, column)),
    ));
}

struct Similarity {
    ssim: vec4f,
    by_mean: vec4f,
    by_variance: vec4f,
    by_covariance: vec4f,
}

fn similarity(x: vec4f, y: vec4f, squares: vec4f, xy: vec4f) -> Similarity {
    let a1 = 2.0 * x * y + LUMINANCE;
    let a2 = 2.0 * (xy - x * y) + CONTRAST;
    let b1 = x * x + y * y + LUMINANCE;
    let b2 = squares - x * x - y * y + CONTRAST;
    let ssim = a1 * a2 / (b1 * b2);
    let by_variance = -ssim / b2;
    let by_covariance = 2.0 * a1 / (b1 * b2);
    let by_mean = 2.0 * y * a2 / (b1 * b2) - 2.0 * x * ssim / b1 - 2.0 * x * by_variance - y * by_covariance;
    return Similarity(ssim, by_mean, by_variance, by_covariance);
}

fn pixel_at(row: u32, column: u32) -> u32 {
    return min(row, image.size.y - 1u) * image.size.x + column;
}

fn pixels_at(row: u32, column: u32) -> vec4u {
    return vec4u(
        pixel_at(row, column),
        pixel_at(row + 1u, column),
        pixel_at(row + 2u, column),
        pixel_at(row + 3u, column),
    );
}

fn render_at(pixels: vec4u, channel: u32) -> vec4f {
    let at = 4u * pixels + channel;
    return vec4f(render[at.x], render[at.y], render[at.z], render[at.w]);
}

fn photograph_at(pixels: vec4u) -> vec4u {
    return vec4u(photograph[pixels.x], photograph[pixels.y], photograph[pixels.z], photograph[pixels.w]);
}

fn store(channel: u32, first: u32, column: u32, values: Similarity) {
    let width = image.size.x;
    let pixels = width * image.size.y;
    for (var i = 0u; i < 4u; i++) {
        if first + i < image.size.y {
            let at = channel * pixels + (first + i) * width + column;
            derivatives[at] = values.by_mean[i];
            derivatives[3u * pixels + at] = values.by_variance[i];
            derivatives[6u * pixels + at] = values.by_covariance[i];
        }
    }
}

fn store_losses(first: u32, column: u32, ssim: vec4f, absolute: vec4f, squared: vec4f) {
    for (var i = 0u; i < 4u; i++) {
        if first + i < image.size.y {
            losses[(first + i) * image.size.x + column] = vec4f(ssim[i], absolute[i], squared[i], 0.0);
        }
    }
}

@compute @workgroup_size(64)
fn ssim_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = (group.x + group.y * 65535u) * 64u + local;
    let width = image.size.x;
    let run = index / width;
    let column = index - run * width;
    let first = run * RUN;
    if first >= image.size.y {
        return;
    }
    let reach = i32(first) - REACH;
    let low_pixels = pixels_at(first, column);
    let high_pixels = pixels_at(first + 4u, column);
    let low_packed = photograph_at(low_pixels);
    let high_packed = photograph_at(high_pixels);
    var low_ssim = vec4f(0.0);
    var high_ssim = vec4f(0.0);
    var low_absolute = vec4f(0.0);
    var high_absolute = vec4f(0.0);
    var low_squared = vec4f(0.0);
    var high_squared = vec4f(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        let x = moment(channel, reach, column);
        let y = moment(3u + channel, reach, column);
        let squares = moment(6u + channel, reach, column);
        let xy = moment(9u + channel, reach, column);
        let low = similarity(x.low, y.low, squares.low, xy.low);
        let high = similarity(x.high, y.high, squares.high, xy.high);
        store(channel, first, column, low);
        store(channel, first + 4u, column, high);
        let low_difference = render_at(low_pixels, channel) - unpack(low_packed, channel);
        let high_difference = render_at(high_pixels, channel) - unpack(high_packed, channel);
        low_ssim += low.ssim;
        high_ssim += high.ssim;
        low_absolute += abs(low_difference);
        high_absolute += abs(high_difference);
        low_squared += low_difference * low_difference;
        high_squared += high_difference * high_difference;
    }
    store_losses(first, column, low_ssim, low_absolute, low_squared);
    store_losses(first + 4u, column, high_ssim, high_absolute, high_squared);
}
