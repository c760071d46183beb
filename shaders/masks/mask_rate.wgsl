// Adds the rate's gradient by the mask logits of the sampled anchors: the mask multiplies the bits of its offset's three
// coordinates, and passes the gradient on straight-through, as the logistic of the logit would. A masked offset has no bits.
// Each anchor is sampled at most once.
#import tcgs::index::lane_index
#import tcgs::model::{OFFSETS, logistic}

struct Settings {
    // of a bit, unused, unused, unused
    weight: vec4f,
    // column capacity of the bits, unused, unused, unused
    room: vec4u,
}

@group(0) @binding(0) var<uniform> settings: Settings;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> bits: array<f32>;
@group(0) @binding(3) var<storage, read> logits: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_logits: array<f32>;

@compute @workgroup_size(64)
fn mask_rate(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let sampled = lane_index(group, local);
    if sampled >= list[0] {
        return;
    }
    let first = list[1u + sampled] * OFFSETS;
    for (var k = 0u; k < OFFSETS; k++) {
        let share = logistic(logits[first + k]);
        let cost = bits[(3u + k) * settings.room.x + sampled];
        d_logits[first + k] += settings.weight.x * cost * share * (1.0 - share);
    }
}
