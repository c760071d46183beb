// Rounds colors to 8 bits per channel, four in a word, red lowest: a view takes a quarter of the bytes to read back.

#import tcgs::index::lane_index

@group(0) @binding(0) var<uniform> count: u32;
@group(0) @binding(1) var<storage, read> image: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> words: array<u32>;

@compute @workgroup_size(64)
fn pack_image(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = lane_index(group, local);
    if i >= count {
        return;
    }
    let level = clamp(image[i].rgb, vec3f(0.0), vec3f(1.0)) * 255.0;
    // Halves go up, which `round` leaves open.
    let below = floor(level);
    let rounded = vec3u(below + select(vec3f(0.0), vec3f(1.0), level - below >= vec3f(0.5)));
    words[i] = rounded.r | (rounded.g << 8u) | (rounded.b << 16u) | (255u << 24u);
}
