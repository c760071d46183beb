// Blends each tile's Gaussians front to back, one invocation a pixel.

#import tcgs::view::{TILE, View, tile_pixel}
#import tcgs::splat::{ALPHA_MAX, ALPHA_MIN, NONE, TRANSMITTANCE_MIN, power_at, touches}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> splats: array<vec4<f32>>;
// Colour over the background, and the transmittance that is left.
@group(0) @binding(4) var<storage, read_write> image: array<vec4<f32>>;
// One more than the place in the tile's list of the last Gaussian that the pixel took.
@group(0) @binding(5) var<storage, read_write> last: array<u32>;

struct Pixel {
    center: vec2<f32>,
    color: vec3<f32>,
    transmittance: f32,
    last: u32,
    done: bool,
}

fn blend(pixel: ptr<function, Pixel>, place: vec3<f32>, conic: vec3<f32>, color: vec3<f32>, index: u32) {
    let power = power_at(conic, place.xy - (*pixel).center);
    let alpha = min(ALPHA_MAX, place.z * exp(-power));
    if (*pixel).done || power < 0.0 || alpha < ALPHA_MIN {
        return;
    }
    let next = (*pixel).transmittance * (1.0 - alpha);
    if next <= TRANSMITTANCE_MIN {
        (*pixel).done = true;
        return;
    }
    (*pixel).color += alpha * (*pixel).transmittance * color;
    (*pixel).transmittance = next;
    (*pixel).last = index + 1u;
}

@compute @workgroup_size(256)
fn raster_forward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
#ifdef SUBGROUPS
    @builtin(subgroup_invocation_id) lane: u32,
#endif
) {
    let tile = group.x + group.y * 65535u;
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let position = vec2<u32>(tile % view.tiles.x, tile / view.tiles.x) * TILE + tile_pixel(local);
    let inside = all(position < view.size);
    let range = ranges[tile];
    var pixel = Pixel(vec2<f32>(position) + 0.5, vec3<f32>(0.0), 1.0, 0u, !inside);
#ifdef SUBGROUPS
    // Each lane fetches another Gaussian and tests it against the block of pixels that the subgroup covers; those
    // that touch it are handed round.
    const LANES: u32 = #{SUBGROUPS}u;
    let low = subgroupMin(pixel.center);
    let high = subgroupMax(pixel.center);
    for (var base = range.x; base < range.y; base += LANES) {
        if subgroupAll(pixel.done) {
            break;
        }
        var place = vec4<f32>(0.0);
        var conic = vec4<f32>(1.0);
        var color = vec4<f32>(0.0);
        var hit = false;
        if base + lane < range.y {
            let id = list[base + lane];
            if id != NONE {
                place = splats[3u * id];
                conic = splats[3u * id + 1u];
                color = splats[3u * id + 2u];
                hit = touches(place, conic.xyz, low, high);
            }
        }
        let hits = subgroupBallot(hit);
        for (var word = 0u; word < (LANES + 31u) / 32u; word++) {
            var mask = hits.x;
            if word == 1u {
                mask = hits.y;
            }
            while mask != 0u {
                let k = word * 32u + firstTrailingBit(mask);
                mask &= mask - 1u;
                blend(
                    &pixel,
                    subgroupShuffle(place.xyz, k),
                    subgroupShuffle(conic.xyz, k),
                    subgroupShuffle(color.xyz, k),
                    base + k - range.x,
                );
            }
        }
    }
#else
    for (var i = range.x; i < range.y && !pixel.done; i++) {
        let id = list[i];
        if id != NONE {
            blend(&pixel, splats[3u * id].xyz, splats[3u * id + 1u].xyz, splats[3u * id + 2u].xyz, i - range.x);
        }
    }
#endif
    if inside {
        let i = position.y * view.size.x + position.x;
        image[i] = vec4<f32>(pixel.color + pixel.transmittance * view.background.xyz, pixel.transmittance);
        last[i] = pixel.last;
    }
}
