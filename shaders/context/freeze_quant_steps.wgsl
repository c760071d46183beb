// Replaces the adjustments that the networks predict for the sampled anchors by the anchors' own steps, and stores the
// prediction errors: while attributes are frozen, rates are measured at the steps that the anchors have.

#import tcgs::index::lane_index

struct Settings {
    // base steps of features, scalings, offsets, unused
    base: vec4f,
    // rows of the three adjustments among the outputs, column capacity of the outputs
    rows: vec4u,
}

@group(0) @binding(0) var<uniform> settings: Settings;
// How many anchors are sampled, then which.
@group(0) @binding(1) var<storage, read> list: array<u32>;
// [N][3], in the units of the base steps.
@group(0) @binding(2) var<storage, read> steps: array<f32>;
@group(0) @binding(3) var<storage, read_write> outputs: array<f32>;
// Column-major: predicted less held, in octaves, for each group.
@group(0) @binding(4) var<storage, read_write> differences: array<f32>;

@compute @workgroup_size(64)
fn freeze_quant_steps(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let sampled = lane_index(group, local);
    if sampled >= list[0] {
        return;
    }
    let anchor = list[1u + sampled];
    let room = settings.rows.w;
    for (var place = 0u; place < 3u; place++) {
        let at = settings.rows[place] * room + sampled;
        let held = log2(steps[3u * anchor + place] / settings.base[place]);
        differences[place * room + sampled] = outputs[at] - held;
        outputs[at] = held;
    }
}
