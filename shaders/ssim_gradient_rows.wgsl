// First half of the window's adjoint, along rows, for the three derivative fields of SSIM, three planes each. The
// window is symmetric and zero-padded, so it is its own adjoint.
#import tcgs::ssim::{Image, Line, REACH, RUN, windows}

const PLANES: u32 = 9u;

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> derivatives: array<f32>;
@group(0) @binding(2) var<storage, read_write> blurred: array<f32>;

// Outside the image there is zero.
fn sample(base: u32, column: i32) -> f32 {
    let width = i32(image.size.x);
    return select(0.0, derivatives[base + u32(clamp(column, 0, width - 1))], column >= 0 && column < width);
}

fn samples(base: u32, column: i32) -> vec4f {
    return vec4f(
        sample(base, column),
        sample(base, column + 1),
        sample(base, column + 2),
        sample(base, column + 3),
    );
}

@compute @workgroup_size(64)
fn ssim_gradient_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = (group.x + group.y * 65535u) * 64u + local;
    let width = image.size.x;
    let runs = (width + RUN - 1u) / RUN;
    let row = index / runs;
    if row >= image.size.y {
        return;
    }
    let first = (index - row * runs) * RUN;
    let reach = i32(first) - REACH;
    for (var plane = 0u; plane < PLANES; plane++) {
        let base = (plane * image.size.y + row) * width;
        let sums = windows(Line(
            samples(base, reach),
            samples(base, reach + 4),
            samples(base, reach + 8),
            samples(base, reach + 12),
            vec2f(sample(base, reach + 16), sample(base, reach + 17)),
        ));
        for (var i = 0u; i < 4u; i++) {
            if first + i < width {
                blurred[base + first + i] = sums.low[i];
            }
            if first + 4u + i < width {
                blurred[base + first + 4u + i] = sums.high[i];
            }
        }
    }
}
