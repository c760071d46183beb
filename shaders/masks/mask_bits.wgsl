// The binary masks of the logits (METHOD.md §4.1): bit k of an anchor's word is set where the logit of its offset k
// is above the level.
#import tcgs::index::lane_index
#import tcgs::model::OFFSETS

struct Settings {
    // level, unused, unused, unused
    level: vec4f,
    // anchors, unused, unused, unused
    count: vec4u,
}

@group(0) @binding(0) var<uniform> settings: Settings;
@group(0) @binding(1) var<storage, read> logits: array<f32>;
@group(0) @binding(2) var<storage, read_write> masks: array<u32>;

@compute @workgroup_size(64)
fn mask_bits(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let anchor = lane_index(group, local);
    if anchor >= settings.count.x {
        return;
    }
    var bits = 0u;
    for (var k = 0u; k < OFFSETS; k++) {
        bits |= u32(logits[anchor * OFFSETS + k] > settings.level.x) << k;
    }
    masks[anchor] = bits;
}
