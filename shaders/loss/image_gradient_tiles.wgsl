// The gradient of the image loss by the rendered samples of a tile on hardware: L1's sign, and SSIM's through the window's adjoint,
// along rows and columns (METHOD.md §2.4). The window is symmetric and zero-padded, so it is its own adjoint. The fourth component,
// the gradient by alpha, stays zero. A workgroup makes one channel of a tile.
#import tcgs::ssim::Image
#import tcgs::ssim_tile::{
    Line, LANES, READERS, HALO, RUNS, FIELD, PITCH, blurred, column_sums, halo_sample, level, pixel_counts, place_of, row_run,
    store_row_sums, work_of,
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
    let column = local % READERS;
    for (var row = local / READERS; column < HALO && row < HALO; row += LANES / READERS) {
        let sample = halo_sample(image, origin, column, row);
        let at = field + sample.pixel;
        // All reads come first, so that they are under way together.
        let by_mean = derivatives[at];
        let by_squares = derivatives[at + pixels];
        let by_difference = derivatives[at + 2u * pixels];
        fields[sample.at] = select(0.0, by_mean, sample.inside);
        fields[FIELD + sample.at] = select(0.0, by_squares, sample.inside);
        fields[2u * FIELD + sample.at] = select(0.0, by_difference, sample.inside);
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

// Sums along a column and writes the gradients of the lane's pixels. All samples are read before the first gradient is written, so
// that the reads are under way together.
fn finish(origin: vec2u, channel: u32, local: u32) {
    let first = place_of(local);
    let sums = column_sums(first.x, first.y);
    let place = origin + first;
    if any(place >= image.size.xy) {
        return;
    }
    let pixels = (place.y + vec4u(0u, 1u, 2u, 3u)) * image.size.x + place.x;
    let held = min(pixels, vec4u(image.size.x * image.size.y - 1u));
    let x = vec4f(
        render[4u * held.x + channel],
        render[4u * held.y + channel],
        render[4u * held.z + channel],
        render[4u * held.w + channel],
    );
    let y = vec4f(
        level(photograph[held.x], channel),
        level(photograph[held.y], channel),
        level(photograph[held.z], channel),
        level(photograph[held.w], channel),
    );
    let difference = x - y;
    let d_ssim = sums[0] + 2.0 * (x * sums[1] + difference * sums[2]);
    var gradient = image.weights.x * sign(difference) - image.weights.y * d_ssim;
#ifdef MASKED
    gradient = select(vec4f(0.0), gradient, vec4<bool>(
        pixel_counts(photograph[held.x]),
        pixel_counts(photograph[held.y]),
        pixel_counts(photograph[held.z]),
        pixel_counts(photograph[held.w]),
    ));
#endif
    for (var k = 0u; k < 4u; k++) {
        if place.y + k < image.size.y {
            d_image[4u * pixels[k] + channel] = gradient[k];
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
