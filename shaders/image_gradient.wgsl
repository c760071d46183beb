// The gradient of the image loss by each rendered sample: L1's sign, and SSIM's through the second half of the
// window's adjoint (method.md section 1.5). The fourth component, the gradient by alpha, is zero.
#import tcgs::ssim::{Image, Line, Windows, REACH, RUN, unpack, windows}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<f32>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read> blurred: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_image: array<f32>;

// Outside the image there is zero.
fn sample(plane: u32, row: i32, column: u32) -> f32 {
    let height = i32(image.size.y);
    let at = (plane * image.size.y + u32(clamp(row, 0, height - 1))) * image.size.x + column;
    return select(0.0, blurred[at], row >= 0 && row < height);
}

fn samples(plane: u32, row: i32, column: u32) -> vec4f {
    return vec4f(
        sample(plane, row, column),
        sample(plane, row + 1, column),
        sample(plane, row + 2, column),
        sample(plane, row + 3, column),
    );
}

fn field(plane: u32, row: i32, column: u32) -> Windows {
    return windows(Line(
        samples(plane, row, column),
        samples(plane, row + 4, column),
        samples(plane, row + 8, column),
        samples(plane, row + 12, column),
        vec2f(sample(plane, row + 16, column), sample(plane, row + 17, column)),
    ));
}

// The gradient by one channel of four pixels.
fn store(first: u32, column: u32, channel: u32, mean: vec4f, variance: vec4f, covariance: vec4f) {
    for (var i = 0u; i < 4u; i++) {
        if first + i < image.size.y {
            let pixel = (first + i) * image.size.x + column;
            let x = render[4u * pixel + channel];
            let y = unpack(vec4u(photograph[pixel]), channel).x;
            let d_ssim = mean[i] + 2.0 * x * variance[i] + y * covariance[i];
            d_image[4u * pixel + channel] = image.weights.x * sign(x - y) - image.weights.y * d_ssim;
        }
    }
}

@compute @workgroup_size(64)
fn image_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = (group.x + group.y * 65535u) * 64u + local;
    let run = index / image.size.x;
    let column = index - run * image.size.x;
    let first = run * RUN;
    if first >= image.size.y {
        return;
    }
    let reach = i32(first) - REACH;
    for (var channel = 0u; channel < 3u; channel++) {
        let mean = field(channel, reach, column);
        let variance = field(3u + channel, reach, column);
        let covariance = field(6u + channel, reach, column);
        store(first, column, channel, mean.low, variance.low, covariance.low);
        store(first + 4u, column, channel, mean.high, variance.high, covariance.high);
    }
    for (var row = first; row < min(first + RUN, image.size.y); row++) {
        d_image[4u * (row * image.size.x + column) + 3u] = 0.0;
    }
}
