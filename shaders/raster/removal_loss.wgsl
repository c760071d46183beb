// The change of a view's absolute error if an intersection's Gaussian were not in its tile (METHOD.md §5): one workgroup walks one
// tile's list front to back, eight Gaussians at a time, and writes each intersection's sum once, so that the result does not depend on
// scheduling.
//
// Where the run learns color corrections (CORRECTED), errors are those of the corrected render (METHOD.md §2.11). A change of its color
// is the same linear map of a change of the render's.
//
// Without a Gaussian, what it adds to a pixel is gone, and what lies behind it is brighter by its share of what it hides. The sum goes
// where `raster_backward` writes the gradient by the opacity, with zeros beside it, so that `gather` and `project_backward` bring it to
// the Gaussian.
#import tcgs::view::{TILE, View, tile_pixel}
#import tcgs::splat::{ALPHA_MAX, ALPHA_MIN, NONE, power_at}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4f>;
@group(0) @binding(5) var<storage, read> image: array<vec4f>;
@group(0) @binding(6) var<storage, read> last: array<u32>;
// Red, green and blue in the low bytes, and 255 in the highest where the pixel counts.
@group(0) @binding(7) var<storage, read> photograph: array<u32>;
// Nine numbers per slot, of which the third is the sum.
@group(0) @binding(8) var<storage, read_write> slot_sums: array<f32>;
#ifdef CORRECTED
// The photograph's correction: three rows, each a row of A and then the component of b.
@group(0) @binding(9) var<uniform> correction: array<vec4f, 3>;
#endif

const LANES: u32 = #{LANES}u;
const CHUNK: u32 = 8u;
const PIXELS: u32 = TILE * TILE;

// State of every pixel of the tile between chunks; a lane accesses only its own entries.
var<workgroup> transmittances: array<f32, PIXELS>;
// What the remaining Gaussians and the background add.
var<workgroup> behinds: array<vec4f, PIXELS>;
// Render, corrected or not, minus photograph; the fourth is one where the pixel counts.
var<workgroup> errors: array<vec4f, PIXELS>;
var<workgroup> lasts: array<u32, PIXELS>;
var<workgroup> stages: array<Stage, CHUNK>;
var<workgroup> partial: array<f32, CHUNK * LANES>;
var<workgroup> tile_last: atomic<u32>;

struct Stage {
    place: vec4f,
    conic: vec4f,
    color: vec4f,
}

// What the loss sees of a color, whose fourth component is one, or of a change of a color, whose fourth is zero.
fn seen_by_loss(color: vec4f) -> vec3f {
#ifdef CORRECTED
    return vec3f(dot(correction[0], color), dot(correction[1], color), dot(correction[2], color));
#else
    return color.xyz;
#endif
}

@compute @workgroup_size(LANES)
fn removal_loss(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = part_of(group, groups);
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let origin = vec2u(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let range = ranges[tile];
    let count = range.y - range.x;
    var furthest = 0u;
    for (var p = lane; p < PIXELS; p += LANES) {
        let position = origin + tile_pixel(p);
        var seen = vec4f(0.0);
        var error = vec4f(0.0);
        var taken = 0u;
        if all(position < view.size) {
            let i = position.y * view.size.x + position.x;
            seen = image[i];
            let wanted = unpack4x8unorm(photograph[i]);
            error = vec4f(seen_by_loss(vec4f(seen.xyz, 1.0)) - wanted.xyz, select(0.0, 1.0, wanted.w > 0.5));
            taken = last[i];
        }
        transmittances[p] = 1.0;
        behinds[p] = seen;
        errors[p] = error;
        lasts[p] = taken;
        furthest = max(furthest, taken);
    }
    if lane == 0u {
        atomicStore(&tile_last, 0u);
    }
    workgroupBarrier();
    atomicMax(&tile_last, furthest);
    workgroupBarrier();
    let used = workgroupUniformLoad(&tile_last);
    for (var base = 0u; base < used; base += CHUNK) {
        let item = range.x + base + lane;
        let owns = lane < CHUNK && item < range.y;
        var stage = Stage(vec4f(0.0), vec4f(1.0), vec4f(0.0));
        if owns {
            let id = list[item];
            if id != NONE {
                stage = Stage(splats[3u * id], splats[3u * id + 1u], splats[3u * id + 2u]);
            }
        }
        workgroupBarrier();
        if lane < CHUNK {
            stages[lane] = stage;
        }
        workgroupBarrier();
        var sums = array<f32, CHUNK>();
        for (var p = lane; p < PIXELS; p += LANES) {
            let center = vec2f(origin + tile_pixel(p)) + 0.5;
            let error = errors[p];
            let end = lasts[p];
            var transmittance = transmittances[p];
            var behind = behinds[p].xyz;
            for (var k = 0u; k < CHUNK; k++) {
                let splat = stages[k];
                let power = power_at(splat.conic.xyz, splat.place.xy - center);
                let alpha = min(ALPHA_MAX, splat.place.z * exp(-power));
                if !(base + k >= end || power < 0.0 || alpha < ALPHA_MIN) {
                    let own = alpha * transmittance * splat.color.xyz;
                    behind = max(behind - own, vec3f(0.0));
                    let revealed = behind * (alpha / (1.0 - alpha));
                    let without = error.xyz + seen_by_loss(vec4f(revealed, 0.0)) - seen_by_loss(vec4f(own, 0.0));
                    sums[k] += error.w * dot(abs(without) - abs(error.xyz), vec3f(1.0));
                    transmittance *= 1.0 - alpha;
                }
            }
            transmittances[p] = transmittance;
            behinds[p] = vec4f(behind, 0.0);
        }
        for (var k = 0u; k < CHUNK; k++) {
            partial[k * LANES + lane] = sums[k];
        }
        workgroupBarrier();
        if owns {
            var sum = 0.0;
            for (var other = 0u; other < LANES; other++) {
                sum += partial[lane * LANES + other];
            }
            store(slots[item], sum);
        }
    }
    // Slots that reach no pixel change nothing.
    let rest = (used + CHUNK - 1u) / CHUNK * CHUNK;
    for (var i = rest + lane; i < count; i += LANES) {
        store(slots[range.x + i], 0.0);
    }
}

fn store(slot: u32, sum: f32) {
    let i = 9u * slot;
    for (var j = 0u; j < 9u; j++) {
        slot_sums[i + j] = select(0.0, sum, j == 2u);
    }
}
