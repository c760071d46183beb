// Gradients of each (Gaussian, tile) intersection: one workgroup walks one tile's list front to back, eight Gaussians at
// a time, and writes each intersection's sums once, so the result does not depend on scheduling.
//
// Each lane is a pixel; blocks of as many pixels as there are lanes are processed in turn and skipped if none of the eight
// Gaussians reaches them. Each lane keeps eight private sums, which are added over the lanes once per eight Gaussians.
//
// With subgroups, a workgroup is one subgroup, or the first lanes of one that is wider.

#import tcgs::view::{TILE, View, tile_pixel}
#import tcgs::splat::{ALPHA_MAX, ALPHA_MIN, NONE, power_at, ridges_of, touches}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> splats: array<vec4f>;
@group(0) @binding(5) var<storage, read> image: array<vec4f>;
@group(0) @binding(6) var<storage, read> last: array<u32>;
@group(0) @binding(7) var<storage, read> d_image: array<vec4f>;
// Nine numbers per slot: center (2), opacity, conic (3), color (3).
@group(0) @binding(8) var<storage, read_write> slot_gradients: array<f32>;

#ifdef SUBGROUPS
const LANES: u32 = #{SUBGROUPS}u;
#else
const LANES: u32 = 16u;
#endif
const CHUNK: u32 = 8u;
const PIXELS: u32 = TILE * TILE;

// State of every pixel of the tile between chunks; a lane accesses only its own entries.
var<workgroup> transmittances: array<f32, PIXELS>;
var<workgroup> remainders: array<f32, PIXELS>;
var<workgroup> lasts: array<u32, PIXELS>;
var<workgroup> weights: array<vec4f, PIXELS>;

struct Stage {
    place: vec4f,
    conic: vec4f,
    color: vec4f,
}

struct Pixel {
    center: vec2f,
    // dL/d(r, g, b, alpha).
    weight: vec4f,
    last: u32,
    transmittance: f32,
    // Contribution of the remaining Gaussians and the background to the loss's differential.
    remainder: f32,
}

struct Gradient {
    // Center (xy), opacity (z), first conic entry (w).
    a: vec4f,
    // Other conic entries (xy), red and green (zw).
    b: vec4f,
    // Blue.
    c: f32,
}

#ifdef SUBGROUPS
fn fetch(stage: Stage, k: u32) -> Stage {
    return Stage(
        subgroupShuffle(stage.place, k),
        subgroupShuffle(stage.conic, k),
        subgroupShuffle(stage.color, k),
    );
}
#else
var<workgroup> stages: array<Stage, CHUNK>;
var<workgroup> tile_last: atomic<u32>;
// Nine numbers of each lane for each Gaussian of the chunk.
var<workgroup> partial: array<f32, CHUNK * 9u * LANES>;

fn fetch(stage: Stage, k: u32) -> Stage {
    return stages[k];
}
#endif

// Lanes without work must reconverge with the others before the next shuffle, and only the end of an `if` guarantees that.
// The final return is explicit, since naga would move it into the branches of a last `if`.
fn visit(k: u32, mask: u32, base: u32, stage: Stage, pixel: ptr<function, Pixel>, gradient: ptr<function, Gradient>) {
    if (mask & (1u << k)) != 0u {
        let splat = fetch(stage, k);
        let d = splat.place.xy - (*pixel).center;
        let power = power_at(splat.conic.xyz, d);
        let falloff = exp(-power);
        let raw = splat.place.z * falloff;
        let alpha = min(ALPHA_MAX, raw);
        if !(base + k >= (*pixel).last || power < 0.0 || alpha < ALPHA_MIN) {
            let weight = alpha * (*pixel).transmittance;
            let value = dot((*pixel).weight, vec4f(splat.color.xyz, 1.0));
            (*pixel).remainder -= weight * value;
            let d_alpha = (*pixel).transmittance * value - (*pixel).remainder / (1.0 - alpha);
            (*pixel).transmittance *= 1.0 - alpha;
            let d_raw = select(d_alpha, 0.0, raw > ALPHA_MAX);
            let d_power = -raw * d_raw;
            let d_color = weight * (*pixel).weight.xyz;
            let d_center = d_power * vec2f(dot(splat.conic.xy, d), dot(splat.conic.yz, d));
            (*gradient).a += vec4f(d_center, falloff * d_raw, 0.5 * d.x * d.x * d_power);
            (*gradient).b += vec4f(d.x * d.y * d_power, 0.5 * d.y * d.y * d_power, d_color.xy);
            (*gradient).c += d_color.z;
        }
    }
    return;
}

fn store(slot: u32, a: vec4f, b: vec4f, c: f32) {
    let i = 9u * slot;
    slot_gradients[i] = a.x;
    slot_gradients[i + 1u] = a.y;
    slot_gradients[i + 2u] = a.z;
    slot_gradients[i + 3u] = a.w;
    slot_gradients[i + 4u] = b.x;
    slot_gradients[i + 5u] = b.y;
    slot_gradients[i + 6u] = b.z;
    slot_gradients[i + 7u] = b.w;
    slot_gradients[i + 8u] = c;
}

#ifdef SUBGROUPS
// Sums of eight vectors over the lanes; lane l receives the sum of the (l mod 8)-th.
fn sum_lanes(
    lane: u32,
    v0: vec4f, v1: vec4f, v2: vec4f, v3: vec4f,
    v4: vec4f, v5: vec4f, v6: vec4f, v7: vec4f,
) -> vec4f {
    let upper = (lane & 4u) != 0u;
    let a0 = select(v0, v4, upper) + subgroupShuffleXor(select(v4, v0, upper), 4u);
    let a1 = select(v1, v5, upper) + subgroupShuffleXor(select(v5, v1, upper), 4u);
    let a2 = select(v2, v6, upper) + subgroupShuffleXor(select(v6, v2, upper), 4u);
    let a3 = select(v3, v7, upper) + subgroupShuffleXor(select(v7, v3, upper), 4u);
    let middle = (lane & 2u) != 0u;
    let b0 = select(a0, a2, middle) + subgroupShuffleXor(select(a2, a0, middle), 2u);
    let b1 = select(a1, a3, middle) + subgroupShuffleXor(select(a3, a1, middle), 2u);
    let odd = (lane & 1u) != 0u;
    var sum = select(b0, b1, odd) + subgroupShuffleXor(select(b1, b0, odd), 1u);
    for (var stride = 8u; stride < LANES; stride *= 2u) {
        sum += subgroupShuffleXor(sum, stride);
    }
    return sum;
}
#else
fn share(lane: u32, k: u32, own: Gradient) {
    let i = k * 9u * LANES + lane;
    partial[i] = own.a.x;
    partial[i + LANES] = own.a.y;
    partial[i + 2u * LANES] = own.a.z;
    partial[i + 3u * LANES] = own.a.w;
    partial[i + 4u * LANES] = own.b.x;
    partial[i + 5u * LANES] = own.b.y;
    partial[i + 6u * LANES] = own.b.z;
    partial[i + 7u * LANES] = own.b.w;
    partial[i + 8u * LANES] = own.c;
}
#endif

@compute @workgroup_size(LANES)
fn raster_backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
#ifdef SUBGROUPS
    @builtin(subgroup_invocation_id) lane: u32,
#else
    @builtin(local_invocation_index) lane: u32,
#endif
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
        var weight = vec4f(0.0);
        var remainder = 0.0;
        var taken = 0u;
        if all(position < view.size) {
            let i = position.y * view.size.x + position.x;
            let seen = image[i];
            weight = d_image[i];
            remainder = dot(weight, vec4f(seen.xyz, 1.0 - seen.w));
            taken = last[i];
        }
        transmittances[p] = 1.0;
        remainders[p] = remainder;
        weights[p] = weight;
        lasts[p] = taken;
        furthest = max(furthest, taken);
    }
#ifdef SUBGROUPS
    let used = subgroupMax(furthest);
#else
    if lane == 0u {
        atomicStore(&tile_last, 0u);
    }
    workgroupBarrier();
    atomicMax(&tile_last, furthest);
    workgroupBarrier();
    let used = workgroupUniformLoad(&tile_last);
#endif
    for (var base = 0u; base < used; base += CHUNK) {
        let item = range.x + base + lane;
        let owns = lane < CHUNK && item < range.y;
        var stage = Stage(vec4f(0.0), vec4f(1.0), vec4f(0.0));
        var present = false;
        if owns {
            let id = list[item];
            if id != NONE {
                stage = Stage(splats[3u * id], splats[3u * id + 1u], splats[3u * id + 2u]);
                present = true;
            }
        }
#ifndef SUBGROUPS
        workgroupBarrier();
        if lane < CHUNK {
            stages[lane] = stage;
        }
        workgroupBarrier();
#endif
        var g0 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
        var g1 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
        var g2 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
        var g3 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
        var g4 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
        var g5 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
        var g6 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
        var g7 = Gradient(vec4f(0.0), vec4f(0.0), 0.0);
#ifdef SUBGROUPS
        let ridges = ridges_of(stage.conic.xyz);
#endif
        for (var block = 0u; block < PIXELS; block += LANES) {
            let p = block + lane;
#ifdef SUBGROUPS
            let low = vec2f(origin + tile_pixel(block)) + 0.5;
            let high = vec2f(origin + tile_pixel(block + LANES - 1u)) + 0.5;
            let mask = subgroupBallot(present && touches(stage.place, stage.conic.xyz, ridges, low, high)).x;
            var is_reached = mask != 0u;
            if is_reached {
                is_reached = subgroupAny(lasts[p] > base);
            }
#else
            let mask = 0xffu;
            let is_reached = true;
#endif
            if is_reached {
                let center = vec2f(origin + tile_pixel(p)) + 0.5;
                var pixel = Pixel(center, weights[p], lasts[p], transmittances[p], remainders[p]);
                visit(0u, mask, base, stage, &pixel, &g0);
                visit(1u, mask, base, stage, &pixel, &g1);
                visit(2u, mask, base, stage, &pixel, &g2);
                visit(3u, mask, base, stage, &pixel, &g3);
                visit(4u, mask, base, stage, &pixel, &g4);
                visit(5u, mask, base, stage, &pixel, &g5);
                visit(6u, mask, base, stage, &pixel, &g6);
                visit(7u, mask, base, stage, &pixel, &g7);
                transmittances[p] = pixel.transmittance;
                remainders[p] = pixel.remainder;
            }
        }
#ifdef SUBGROUPS
        let a = sum_lanes(lane, g0.a, g1.a, g2.a, g3.a, g4.a, g5.a, g6.a, g7.a);
        let b = sum_lanes(lane, g0.b, g1.b, g2.b, g3.b, g4.b, g5.b, g6.b, g7.b);
        let c = sum_lanes(
            lane,
            vec4f(g0.c), vec4f(g1.c), vec4f(g2.c), vec4f(g3.c),
            vec4f(g4.c), vec4f(g5.c), vec4f(g6.c), vec4f(g7.c),
        ).x;
#else
        share(lane, 0u, g0);
        share(lane, 1u, g1);
        share(lane, 2u, g2);
        share(lane, 3u, g3);
        share(lane, 4u, g4);
        share(lane, 5u, g5);
        share(lane, 6u, g6);
        share(lane, 7u, g7);
        workgroupBarrier();
        var a = vec4f(0.0);
        var b = vec4f(0.0);
        var c = 0.0;
        if owns {
            for (var other = 0u; other < LANES; other++) {
                let i = lane * 9u * LANES + other;
                a += vec4f(partial[i], partial[i + LANES], partial[i + 2u * LANES], partial[i + 3u * LANES]);
                b += vec4f(
                    partial[i + 4u * LANES],
                    partial[i + 5u * LANES],
                    partial[i + 6u * LANES],
                    partial[i + 7u * LANES],
                );
                c += partial[i + 8u * LANES];
            }
        }
#endif
        if owns {
            store(slots[item], a, b, c);
        }
    }
    // Slots that reach no pixel have no gradient.
    let rest = (used + CHUNK - 1u) / CHUNK * CHUNK;
    for (var i = rest + lane; i < count; i += LANES) {
        store(slots[range.x + i], vec4f(0.0), vec4f(0.0), 0.0);
    }
}
