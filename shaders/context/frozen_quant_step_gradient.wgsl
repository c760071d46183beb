// Writes the gradients of half the squared differences between predicted adjustments and held steps, by the predictions of
// the sampled anchors.

#import tcgs::index::lane_index

struct Settings {
    // of features, scalings, offsets, unused
    weights: vec4f,
    // rows of the three adjustments among the outputs, column capacity of the outputs
    rows: vec4u,
}

@group(0) @binding(0) var<uniform> settings: Settings;
// How many anchors are sampled, then which.
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> differences: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_outputs: array<f32>;

@compute @workgroup_size(64)
fn frozen_quant_step_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let sampled = lane_index(group, local);
    if sampled >= list[0] {
        return;
    }
    let room = settings.rows.w;
    for (var place = 0u; place < 3u; place++) {
        d_outputs[settings.rows[place] * room + sampled] =
            settings.weights[place] * differences[place * room + sampled];
    }
}
