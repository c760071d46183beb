#define_import_path tcgs::ssim_tile
#import tcgs::index::group_index
#import tcgs::ssim::{Image, Tail, REACH, slide}

// Hardware's kernels of the image loss give each workgroup one channel of a tile of TILE x TILE pixels. Both halves of the window are summed in
// workgroup memory, from the tile with its halo of REACH pixels on each side.
const LANES: u32 = 64u;
const TILE: u32 = 16u;
const HALO: u32 = 26u;

// Runs of four sums along rows that a lane makes at a time: four in each row of the tile and its halo.
const RUNS: u32 = HALO * TILE / 4u;

// From row to row in workgroup memory, of samples and of sums along rows: lanes in line use different banks.
const PITCH: u32 = 27u;
const SUM_PITCH: u32 = 17u;

// Samples of a field on the tile and its halo.
const FIELD: u32 = HALO * PITCH;

// Sums along rows of up to four fields.
var<workgroup> row_sums: array<vec4f, HALO * SUM_PITCH>;

// The part of the image that is a workgroup's: tiles in rows, channel by channel.
struct Work {
    exists: bool,
    channel: u32,
    // The pixel of the tile's upper left corner.
    origin: vec2u,
    // The place of its share of the losses: [channel][tile].
    share: u32,
}

fn work_of(image: Image, group: vec3u) -> Work {
    let across = (image.size.x + TILE - 1u) / TILE;
    let tiles = across * ((image.size.y + TILE - 1u) / TILE);
    let index = group_index(group);
    let part = index / tiles;
    let tile = index - part * tiles;
    let row = tile / across;
    let channel = image.channels.x + part;
    return Work(part < image.channels.y, channel, TILE * vec2u(tile - row * across, row), channel * tiles + tile);
}

// Lanes in a row of the halo's reading, a power of two: neighboring lanes read neighboring pixels, and no lane divides.
const READERS: u32 = 32u;

// A sample of the tile and its halo.
struct HaloSample {
    // Its place in a field.
    at: u32,
    // Its pixel, or the nearest one if it is outside the image.
    pixel: u32,
    inside: bool,
}

fn halo_sample(image: Image, origin: vec2u, column: u32, row: u32) -> HaloSample {
    let place = vec2i(origin + vec2u(column, row)) - REACH;
    let held = clamp(place, vec2i(0), vec2i(image.size.xy) - 1);
    let pixel = u32(held.y) * image.size.x + u32(held.x);
    return HaloSample(row * PITCH + column, pixel, all(place == held));
}

// Run `i` along rows. Neighboring lanes take neighboring rows.
struct RowRun {
    row: u32,
    column: u32,
}

fn row_run(i: u32) -> RowRun {
    let first = i / HALO;
    return RowRun(i - first * HALO, 4u * first);
}

// Stores four sums, each a column of the matrix.
fn store_row_sums(run: RowRun, sums: mat4x4f) {
    let at = run.row * SUM_PITCH + run.column;
    row_sums[at] = sums[0];
    row_sums[at + 1u] = sums[1];
    row_sums[at + 2u] = sums[2];
    row_sums[at + 3u] = sums[3];
}

// The sums of each field along rows and columns at four pixels, one below the other.
fn column_sums(column: u32, row: u32) -> mat4x4f {
    let at = row * SUM_PITCH + column;
    let p = SUM_PITCH;
    let a = transpose(mat4x4f(row_sums[at], row_sums[at + p], row_sums[at + 2u * p], row_sums[at + 3u * p]));
    let b = transpose(mat4x4f(row_sums[at + 4u * p], row_sums[at + 5u * p], row_sums[at + 6u * p], row_sums[at + 7u * p]));
    let c = transpose(mat4x4f(row_sums[at + 8u * p], row_sums[at + 9u * p], row_sums[at + 10u * p], row_sums[at + 11u * p]));
    let d = transpose(mat2x4f(row_sums[at + 12u * p], row_sums[at + 13u * p]));
    return mat4x4f(
        blurred(Line(a[0], b[0], c[0], d[0])),
        blurred(Line(a[1], b[1], c[1], d[1])),
        blurred(Line(a[2], b[2], c[2], d[2])),
        blurred(Line(a[3], b[3], c[3], d[3])),
    );
}

// The column of a lane and the first of its four rows.
fn place_of(local: u32) -> vec2u {
    return vec2u(local % TILE, 4u * (local / TILE));
}

// One channel of a packed 8-bit color.
fn level(packed: u32, channel: u32) -> f32 {
    return f32((packed >> (8u * channel)) & 255u) / 255.0;
}

// Whether a pixel counts, as `counted` of tcgs::ssim.
fn pixel_counts(packed: u32) -> bool {
#ifdef MASKED
    return packed >= 0xff000000u;
#else
    return true;
#endif
}

// Fourteen samples in line: all that the windows around the middle four reach.
struct Line {
    a: vec4f,
    b: vec4f,
    c: vec4f,
    d: vec2f,
}

// The windowed sums around the middle four samples.
fn blurred(line: Line) -> vec4f {
    var tail = Tail(line.a, line.b, line.c.xy);
    return slide(&tail, vec4f(line.c.zw, line.d));
}

// The middle four samples.
fn middle(line: Line) -> vec4f {
    return vec4f(line.b.yzw, line.c.x);
}
