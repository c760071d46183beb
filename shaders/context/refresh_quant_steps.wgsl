// Sets the sampled anchors' quantization steps of the attribute groups to the base steps times the networks' adjustments. An
// adjustment that is not finite leaves its step unchanged; an overflowed forward pass leaves all unchanged.
//
// A separate kernel, because `rate` with the steps would bind more storage buffers than WebGPU allows.
#import tcgs::index::group_index
#import tcgs::rate::{GROUPS, Settings, adjustment_of}

@group(0) @binding(0) var<uniform> groups: array<Settings, GROUPS>;
// How many anchors are sampled, then which.
@group(0) @binding(1) var<storage, read> list: array<u32>;
// Column-major; a group's last row is the adjustment.
@group(0) @binding(2) var<storage, read> outputs: array<f32>;
// Not 0 once a forward pass has overflowed: the step is repeated.
@group(0) @binding(3) var<storage, read> overflow_flag: array<u32>;
@group(0) @binding(4) var<storage, read_write> steps: array<f32>;

@compute @workgroup_size(64)
fn refresh_quant_steps(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let block = group_index(group);
    let settings = groups[block % GROUPS];
    let sampled = block / GROUPS * 64u + local;
    if sampled >= list[0] || overflow_flag[0] != 0u {
        return;
    }
    let place = settings.group.z;
    let row = settings.group.w + 2u * settings.group.y;
    let adjustment = adjustment_of(outputs[row * settings.room.x + sampled], settings.quantization.shape.y);
    if adjustment.is_number {
        steps[3u * list[1u + sampled] + place] = settings.quantization.base[place] * exp2(adjustment.octaves);
    }
}
