// SSIM of a tile on hardware: its window along rows and columns, from the moments x, y, x^2 + y^2 and (x - y)^2 of render and
// photograph; the derivatives of the SSIM map by E[x], E[x^2 + y^2] and E[(x - y)^2]; and the tile's share of SSIM, L1 and the
// squared error. A workgroup makes one channel of a tile.
#import tcgs::ssim::{Image, REACH, similarity, total}
#import tcgs::ssim_tile::{
    Line, LANES, READERS, TILE, HALO, RUNS, FIELD, PITCH, blurred, column_sums, halo_sample, level, middle, pixel_counts, place_of,
    row_run, store_row_sums, work_of,
}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<f32>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
// [channel][derivative][pixel]
@group(0) @binding(3) var<storage, read_write> derivatives: array<f32>;
// [channel][tile]
@group(0) @binding(4) var<storage, read_write> losses: array<vec4f>;

// Samples of the render, then of the photograph, on the tile and its halo; zero outside the image and where a pixel does not count.
var<workgroup> samples: array<f32, 2u * FIELD>;
// Each lane's share of the losses.
var<workgroup> shares: array<vec4f, LANES>;

fn load(origin: vec2u, channel: u32, local: u32) {
    let column = local % READERS;
    for (var row = local / READERS; column < HALO && row < HALO; row += LANES / READERS) {
        let sample = halo_sample(image, origin, column, row);
        let x = render[4u * sample.pixel + channel];
        let packed = photograph[sample.pixel];
        let y = level(packed, channel);
        let counts = sample.inside && pixel_counts(packed);
        samples[sample.at] = select(0.0, x, counts);
        samples[FIELD + sample.at] = select(0.0, y, counts);
    }
}

fn line_at(at: u32) -> Line {
    return Line(
        vec4f(samples[at], samples[at + 1u], samples[at + 2u], samples[at + 3u]),
        vec4f(samples[at + 4u], samples[at + 5u], samples[at + 6u], samples[at + 7u]),
        vec4f(samples[at + 8u], samples[at + 9u], samples[at + 10u], samples[at + 11u]),
        vec2f(samples[at + 12u], samples[at + 13u]),
    );
}

// Sums the moments along rows; returns the lane's share of the absolute and of the squared difference.
fn sum_rows(local: u32) -> vec2f {
    var absolute = vec4f(0.0);
    var squared = vec4f(0.0);
    for (var i = local; i < RUNS; i += LANES) {
        let run = row_run(i);
        let at = run.row * PITCH + run.column;
        let x = line_at(at);
        let y = line_at(FIELD + at);
        let m = Line(x.a - y.a, x.b - y.b, x.c - y.c, x.d - y.d);
        store_row_sums(run, transpose(mat4x4f(
            blurred(x),
            blurred(y),
            blurred(Line(x.a * x.a + y.a * y.a, x.b * x.b + y.b * y.b, x.c * x.c + y.c * y.c, x.d * x.d + y.d * y.d)),
            blurred(Line(m.a * m.a, m.b * m.b, m.c * m.c, m.d * m.d)),
        )));
        // Rows of the halo belong to other tiles. Outside the image both samples are zero.
        let own = i32(run.row) >= REACH && i32(run.row) < REACH + i32(TILE);
        let difference = select(vec4f(0.0), middle(m), own);
        absolute += abs(difference);
        squared += difference * difference;
    }
    return vec2f(total(absolute), total(squared));
}

// Sums along a column and compares; returns the SSIM of the lane's pixels, added up.
fn compare(origin: vec2u, channel: u32, local: u32) -> f32 {
    let pixels = image.size.x * image.size.y;
    let field = 3u * (channel - image.channels.x) * pixels;
    let first = place_of(local);
    let sums = column_sums(first.x, first.y);
    let similar = similarity(sums[0], sums[1], sums[2], sums[3]);
    var ssim = 0.0;
    for (var k = 0u; k < 4u; k++) {
        let place = origin + first + vec2u(0u, k);
        if all(place < image.size.xy) {
            let pixel = place.y * image.size.x + place.x;
            let at = field + pixel;
#ifdef MASKED
            if !pixel_counts(photograph[pixel]) {
                derivatives[at] = 0.0;
                derivatives[at + pixels] = 0.0;
                derivatives[at + 2u * pixels] = 0.0;
                continue;
            }
#endif
            derivatives[at] = similar.by_mean[k];
            derivatives[at + pixels] = similar.by_squares[k];
            derivatives[at + 2u * pixels] = similar.by_difference[k];
            ssim += similar.ssim[k];
        }
    }
    return ssim;
}

@compute @workgroup_size(LANES)
fn ssim_tiles(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let work = work_of(image, group);
    // Uniform: all invocations of a workgroup return here or none.
    if !work.exists {
        return;
    }
    load(work.origin, work.channel, local);
    workgroupBarrier();
    let differences = sum_rows(local);
    workgroupBarrier();
    shares[local] = vec4f(compare(work.origin, work.channel, local), differences, 0.0);
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if local < reach {
            shares[local] += shares[local + reach];
        }
        workgroupBarrier();
    }
    if local == 0u {
        losses[work.share] = shares[0];
    }
}
