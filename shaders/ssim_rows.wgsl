// First half of SSIM's window: along rows, the moments x, y, x^2 + y^2 and xy of render and photograph. The squares
// are needed only as their sum. A field is a plane: moments[(3 * moment + channel) * pixels + pixel].
#import tcgs::ssim::{Image, Line, Windows, REACH, RUN, times, plus, unpack, windows}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<f32>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read_write> moments: array<f32>;

// Outside the image there is zero.
fn sample(row: u32, column: i32, channel: u32) -> f32 {
    let width = i32(image.size.x);
    let pixel = row * image.size.x + u32(clamp(column, 0, width - 1));
    return select(0.0, render[4u * pixel + channel], column >= 0 && column < width);
}

fn samples(row: u32, column: i32, channel: u32) -> vec4f {
    return vec4f(
        sample(row, column, channel),
        sample(row, column + 1, channel),
        sample(row, column + 2, channel),
        sample(row, column + 3, channel),
    );
}

fn packed(row: u32, column: i32) -> u32 {
    let width = i32(image.size.x);
    let pixel = row * image.size.x + u32(clamp(column, 0, width - 1));
    return select(0u, photograph[pixel], column >= 0 && column < width);
}

fn packed4(row: u32, column: i32) -> vec4u {
    return vec4u(packed(row, column), packed(row, column + 1), packed(row, column + 2), packed(row, column + 3));
}

fn store(plane: u32, row: u32, first: u32, sums: Windows) {
    let width = image.size.x;
    let base = (plane * image.size.y + row) * width + first;
    for (var i = 0u; i < 4u; i++) {
        if first + i < width {
            moments[base + i] = sums.low[i];
        }
        if first + 4u + i < width {
            moments[base + 4u + i] = sums.high[i];
        }
    }
}

@compute @workgroup_size(64)
fn ssim_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = (group.x + group.y * 65535u) * 64u + local;
    let runs = (image.size.x + RUN - 1u) / RUN;
    let row = index / runs;
    if row >= image.size.y {
        return;
    }
    let first = (index - row * runs) * RUN;
    let reach = i32(first) - REACH;
    let p0 = packed4(row, reach);
    let p1 = packed4(row, reach + 4);
    let p2 = packed4(row, reach + 8);
    let p3 = packed4(row, reach + 12);
    let p4 = vec4u(packed(row, reach + 16), packed(row, reach + 17), 0u, 0u);
    for (var channel = 0u; channel < 3u; channel++) {
        let x = Line(
            samples(row, reach, channel),
            samples(row, reach + 4, channel),
            samples(row, reach + 8, channel),
            samples(row, reach + 12, channel),
            vec2f(sample(row, reach + 16, channel), sample(row, reach + 17, channel)),
        );
        let y = Line(
            unpack(p0, channel),
            unpack(p1, channel),
            unpack(p2, channel),
            unpack(p3, channel),
            unpack(p4, channel).xy,
        );
        store(channel, row, first, windows(x));
        store(3u + channel, row, first, windows(y));
        store(6u + channel, row, first, windows(plus(times(x, x), times(y, y))));
        store(9u + channel, row, first, windows(times(x, y)));
    }
}
