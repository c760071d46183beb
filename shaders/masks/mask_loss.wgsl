// The gradient of the mask loss, weight times the sum of the logistic of every offset's logit, by the logits.
#import tcgs::index::lane_index
#import tcgs::model::logistic

struct Settings {
    // weight of one offset, unused, unused, unused
    weight: vec4f,
    // offsets of all anchors, unused, unused, unused
    count: vec4u,
}

@group(0) @binding(0) var<uniform> settings: Settings;
@group(0) @binding(1) var<storage, read> logits: array<f32>;
@group(0) @binding(2) var<storage, read_write> d_logits: array<f32>;

@compute @workgroup_size(64)
fn mask_loss(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = lane_index(group, local);
    if i >= settings.count.x {
        return;
    }
    let share = logistic(logits[i]);
    d_logits[i] = settings.weight.x * share * (1.0 - share);
}
