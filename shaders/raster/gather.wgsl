// Sums each Gaussian's slots in a fixed order: in runs, and runs of runs, so that the rounding of a sum over ten million slots
// is that of a chain of a few hundred additions. Rows of Gaussians that touch no tile are not written, and never read.

#import tcgs::view::{VISIBLE, View}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
// The visible, nearest first: the order of their slots.
@group(0) @binding(2) var<storage, read> ids: array<u32>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
@group(0) @binding(4) var<storage, read> first_slots: array<u32>;
@group(0) @binding(5) var<storage, read> slot_gradients: array<f32>;
// Three vectors a Gaussian, laid out as the splats.
@group(0) @binding(6) var<storage, read_write> d_splats: array<vec4f>;

const RUN: u32 = 256u;

struct Sums {
    place: vec4f,
    conic: vec4f,
    color: vec4f,
}

fn zero() -> Sums {
    return Sums(vec4f(0.0), vec4f(0.0), vec4f(0.0));
}

fn sum(a: Sums, b: Sums) -> Sums {
    return Sums(a.place + b.place, a.conic + b.conic, a.color + b.color);
}

fn slots(first: u32, end: u32) -> Sums {
    var sums = zero();
    for (var slot = first; slot < end; slot++) {
        let j = 9u * slot;
        sums.place += vec4f(slot_gradients[j], slot_gradients[j + 1u], slot_gradients[j + 2u], 0.0);
        sums.conic += vec4f(slot_gradients[j + 3u], slot_gradients[j + 4u], slot_gradients[j + 5u], 0.0);
        sums.color += vec4f(slot_gradients[j + 6u], slot_gradients[j + 7u], slot_gradients[j + 8u], 0.0);
    }
    return sums;
}

fn runs(first: u32, end: u32) -> Sums {
    var sums = zero();
    for (var run = first; run < end; run += RUN) {
        sums = sum(sums, slots(run, min(end, run + RUN)));
    }
    return sums;
}

@compute @workgroup_size(64)
fn gather(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let begin = part_of(group, groups) * 64u + local;
    let total = min(counters[VISIBLE], view.gaussian_capacity);
    for (var place = begin; place < total; place += groups.x * 64u) {
        let i = ids[place];
        let first = min(first_slots[i], view.intersection_capacity);
        let end = first + min(tiles[i], view.intersection_capacity - first);
        var sums = zero();
        for (var part = first; part < end; part += RUN * RUN) {
            sums = sum(sums, runs(part, min(end, part + RUN * RUN)));
        }
        d_splats[3u * i] = sums.place;
        d_splats[3u * i + 1u] = sums.conic;
        d_splats[3u * i + 2u] = sums.color;
    }
}
