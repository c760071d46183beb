// Blends each tile's Gaussians front to back, four pixels an invocation.

#import tcgs::view::{TILE, View, tile_pixel}
#import tcgs::splat::{ALPHA_MAX, ALPHA_MIN, NONE, NOWHERE, TRANSMITTANCE_MIN, power_at, ridges_of, touches}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> splats: array<vec4f>;
// Color over the background, and the transmittance that is left.
@group(0) @binding(4) var<storage, read_write> image: array<vec4f>;
// One more than the index in the tile's list of the last Gaussian that the pixel blended.
@group(0) @binding(5) var<storage, read_write> last: array<u32>;

struct Pixel {
    center: vec2f,
    color: vec3f,
    transmittance: f32,
    last: u32,
    done: bool,
}

// Lanes without work must reconverge with the others before the next shuffle, and only the end of an `if` guarantees that.
// The final return of functions is explicit, since naga would move it into the branches of a last `if`.
fn blend(pixel: ptr<function, Pixel>, place: vec3f, conic: vec3f, color: vec3f, index: u32) {
    let power = power_at(conic, place.xy - (*pixel).center);
    let alpha = min(ALPHA_MAX, place.z * exp(-power));
    if !((*pixel).done || power < 0.0 || alpha < ALPHA_MIN) {
        let next = (*pixel).transmittance * (1.0 - alpha);
        if next <= TRANSMITTANCE_MIN {
            (*pixel).done = true;
        } else {
            (*pixel).color += alpha * (*pixel).transmittance * color;
            (*pixel).transmittance = next;
            (*pixel).last = index + 1u;
        }
    }
    return;
}

const PIXELS_A_LANE: u32 = 4u;
#ifdef SUBGROUPS
const LANES: u32 = #{SUBGROUPS}u;
#else
const LANES: u32 = 64u;
#endif
// Invocations of a workgroup. Where subgroups may be wider than LANES, each workgroup is the first lanes of one subgroup and
// computes a part of a tile.
#ifdef ONE_SUBGROUP
const GROUP: u32 = LANES;
#else
const GROUP: u32 = 64u;
#endif
const GROUPS_A_TILE: u32 = 64u / GROUP;

fn start(position: vec2u) -> Pixel {
    return Pixel(vec2f(position) + 0.5, vec3f(0.0), 1.0, 0u, any(position >= view.size));
}

fn finish(pixel: Pixel, position: vec2u) {
    if all(position < view.size) {
        let i = position.y * view.size.x + position.x;
        image[i] = vec4f(pixel.color + pixel.transmittance * view.background.xyz, pixel.transmittance);
        last[i] = pixel.last;
    }
    return;
}

#ifdef SUBGROUPS
#ifdef EIGHT_LANES
// Blends the Gaussian of lane k if its bit is set.
fn blend_if(
    pixel: ptr<function, Pixel>,
    mask: u32,
    k: u32,
    place: vec4f,
    conic: vec3f,
    color: vec3f,
    base: u32,
) {
    if (mask & (1u << k)) != 0u {
        blend(
            pixel,
            subgroupShuffle(place.xyz, k),
            subgroupShuffle(conic, k),
            subgroupShuffle(color, k),
            base + k,
        );
    }
    return;
}

// Blends the Gaussians of a chunk that touch the block of pixels that the subgroup's pixels form. Unrolled,
// because on a software adapter reading a constant lane is free and assignments in a loop are masked.
fn blend_chunk(
    pixel: ptr<function, Pixel>,
    place: vec4f,
    conic: vec3f,
    color: vec3f,
    ridges: vec2f,
    low: vec2f,
    high: vec2f,
    base: u32,
) {
    let open = subgroupAny(!(*pixel).done);
    let mask = subgroupBallot(open && touches(place, conic, ridges, low, high)).x;
    if mask != 0u {
        blend_if(pixel, mask, 0u, place, conic, color, base);
        blend_if(pixel, mask, 1u, place, conic, color, base);
        blend_if(pixel, mask, 2u, place, conic, color, base);
        blend_if(pixel, mask, 3u, place, conic, color, base);
        blend_if(pixel, mask, 4u, place, conic, color, base);
        blend_if(pixel, mask, 5u, place, conic, color, base);
        blend_if(pixel, mask, 6u, place, conic, color, base);
        blend_if(pixel, mask, 7u, place, conic, color, base);
    }
    return;
}
#else
// Blends the Gaussians of a chunk that touch the block of pixels that the subgroup's pixels form.
fn blend_chunk(
    pixel: ptr<function, Pixel>,
    place: vec4f,
    conic: vec3f,
    color: vec3f,
    ridges: vec2f,
    low: vec2f,
    high: vec2f,
    base: u32,
) {
    let hits = subgroupBallot(touches(place, conic, ridges, low, high));
    for (var word = 0u; word < (LANES + 31u) / 32u; word++) {
        var mask = select(hits.x, hits.y, word == 1u);
        while mask != 0u {
            let k = word * 32u + firstTrailingBit(mask);
            mask &= mask - 1u;
            blend(
                pixel,
                subgroupShuffle(place.xyz, k),
                subgroupShuffle(conic, k),
                subgroupShuffle(color, k),
                base + k,
            );
        }
    }
}
#endif
#endif

@compute @workgroup_size(GROUP)
fn raster_forward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) invocation: u32,
#ifdef SUBGROUPS
    @builtin(subgroup_invocation_id) lane: u32,
#endif
) {
    let linear = part_of(group, groups);
    let tile = linear / GROUPS_A_TILE;
    let local = linear % GROUPS_A_TILE * GROUP + invocation;
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let origin = vec2u(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let first = local / LANES * LANES * PIXELS_A_LANE + local % LANES;
    let position0 = origin + tile_pixel(first + 0u * LANES);
    var pixel0 = start(position0);
    let position1 = origin + tile_pixel(first + 1u * LANES);
    var pixel1 = start(position1);
    let position2 = origin + tile_pixel(first + 2u * LANES);
    var pixel2 = start(position2);
    let position3 = origin + tile_pixel(first + 3u * LANES);
    var pixel3 = start(position3);
    let range = ranges[tile];
#ifdef SUBGROUPS
    // Each lane fetches another Gaussian; those that touch the block of pixels are broadcast.
    let low0 = subgroupMin(pixel0.center);
    let high0 = subgroupMax(pixel0.center);
    let low1 = subgroupMin(pixel1.center);
    let high1 = subgroupMax(pixel1.center);
    let low2 = subgroupMin(pixel2.center);
    let high2 = subgroupMax(pixel2.center);
    let low3 = subgroupMin(pixel3.center);
    let high3 = subgroupMax(pixel3.center);
    for (var base = range.x; base < range.y; base += LANES) {
        if subgroupAll(pixel0.done && pixel1.done && pixel2.done && pixel3.done) {
            break;
        }
        var place = NOWHERE;
        var conic = vec3f(1.0);
        var color = vec3f(0.0);
        if base + lane < range.y {
            let id = list[base + lane];
            if id != NONE {
                place = splats[3u * id];
                conic = splats[3u * id + 1u].xyz;
                color = splats[3u * id + 2u].xyz;
            }
        }
        let ridges = ridges_of(conic);
        let index = base - range.x;
        blend_chunk(&pixel0, place, conic, color, ridges, low0, high0, index);
        blend_chunk(&pixel1, place, conic, color, ridges, low1, high1, index);
        blend_chunk(&pixel2, place, conic, color, ridges, low2, high2, index);
        blend_chunk(&pixel3, place, conic, color, ridges, low3, high3, index);
    }
#else
    for (var i = range.x; i < range.y && !(pixel0.done && pixel1.done && pixel2.done && pixel3.done); i++) {
        let id = list[i];
        if id != NONE {
            let place = splats[3u * id].xyz;
            let conic = splats[3u * id + 1u].xyz;
            let color = splats[3u * id + 2u].xyz;
            blend(&pixel0, place, conic, color, i - range.x);
            blend(&pixel1, place, conic, color, i - range.x);
            blend(&pixel2, place, conic, color, i - range.x);
            blend(&pixel3, place, conic, color, i - range.x);
        }
    }
#endif
    finish(pixel0, position0);
    finish(pixel1, position1);
    finish(pixel2, position2);
    finish(pixel3, position3);
}
