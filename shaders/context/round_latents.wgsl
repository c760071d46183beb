// Latents as they are stored: the nearest multiples of 1/16 with integers of at most 127 (their gradient passes
// straight-through). One value an invocation.

#import tcgs::index::lane_index

struct Shape {
    // values, first value of the source, unused
    shape: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
@group(0) @binding(1) var<storage, read> source: array<f32>;
@group(0) @binding(2) var<storage, read_write> results: array<f32>;

@compute @workgroup_size(64)
fn round_latents(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    if index < shape.shape.x {
        results[index] = clamp(round(16.0 * source[shape.shape.y + index]), -127.0, 127.0) * 0.0625;
    }
}
