// The gradient of the image loss by the rendered samples of a tile on hardware: L1's sign, and SSIM's through the window's adjoint,
// along rows and columns (METHOD.md §2.4). The window is symmetric and zero-padded, so it is its own adjoint. The fourth component,
// the gradient by alpha, stays zero. A workgroup makes one channel of a tile.
#import tcgs::ssim::Image
#import tcgs::ssim_tile::{
    Line, LANES, HALO, RUNS, FIELD, PITCH, blurred, column_sums, halo_sample, level, place_of, row_run, store_row_sums, work_of,
}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<f32>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
// [channel][derivative][pixel]
@group(0) @binding(3) var<storage, read> derivatives: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_image: array<f32>;

// The three derivatives on the tile and its halo, zero outside the image.
var<workgroup> fields: array<f32, 3u * FIELD>;

fn load(origin: vec2u, channel: u32, local: u32) {
    let pixels = image.size.x * image.size.y;
    let field = 3u * (channel - image.channels.x) * pixels;
    for (var i = local; i < HALO * HALO; i += LANES) {
        let sample = halo_sample(image, origin, i);
        let at = field + sample.pixel;
        fields[sample.at] = select(0.0, derivatives[at], sample.inside);
        fields[FIELD + sample.at] = select(0.0, derivatives[at + pixels], sample.inside);
        fields[2u * FIELD + sample.at] = select(0.0, derivatives[at + 2u * pixels], sample.inside);
    }
}

fn line_at(at: u32) -> Line {
    return Line(
        vec4f(fields[at], fields[at + 1u], fields[at + 2u], fields[at + 3u]),
        vec4f(fields[at + 4u], fields[at + 5u], fields[at + 6u], fields[at + 7u]),
        vec4f(fields[at + 8u], fields[at + 9u], fields[at + 10u], fields[at + 11u]),
        vec2f(fields[at + 12u], fields[at + 13u]),
    );
}

fn sum_rows(local: u32) {
    for (var i = local; i < RUNS; i += LANES) {
        let run = row_run(i);
        let at = run.row * PITCH + run.column;
        store_row_sums(run, transpose(mat4x4f(
            blurred(line_at(at)),
            blurred(line_at(FIELD + at)),
            blurred(line_at(2u * FIELD + at)),
            vec4f(0.0),
        )));
    }
}

// Sums along a column and writes the gradients of the lane's pixels.
fn finish(origin: vec2u, channel: u32, local: u32) {
    let first = place_of(local);
    let sums = column_sums(first.x, first.y);
    for (var k = 0u; k < 4u; k++) {
        let place = origin + first + vec2u(0u, k);
        if all(place < image.size.xy) {
            let pixel = place.y * image.size.x + place.x;
            let x = render[4u * pixel + channel];
            let difference = x - level(photograph[pixel], channel);
            let d_ssim = sums[0][k] + 2.0 * (x * sums[1][k] + difference * sums[2][k]);
            d_image[4u * pixel + channel] = image.weights.x * sign(difference) - image.weights.y * d_ssim;
        }
    }
}

@compute @workgroup_size(LANES)
fn image_gradient_tiles(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let work = work_of(image, group);
    // Uniform: all invocations of a workgroup return here or none.
    if !work.exists {
        return;
    }
    load(work.origin, work.channel, local);
    workgroupBarrier();
    sum_rows(local);
    workgroupBarrier();
    finish(work.origin, work.channel, local);
}
