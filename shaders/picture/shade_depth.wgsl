// Replaces each Gaussian's color by its depth: the rasterizer then blends the expected depth times the pixel's alpha.

#import tcgs::index::lane_index

struct Depths {
    // The third row of the world-to-camera rotation; w is the depth of `eye`.
    forward: vec4f,
    // The camera center, rounded.
    eye: vec4f,
    count: u32,
}

@group(0) @binding(0) var<uniform> depths: Depths;
@group(0) @binding(1) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> colors: array<vec4f>;

@compute @workgroup_size(64)
fn shade_depth(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = lane_index(group, local);
    if i >= depths.count {
        return;
    }
    let depth = dot(depths.forward.xyz, geometry[i].xyz - depths.eye.xyz) + depths.forward.w;
    colors[i] = vec4f(depth, 0.0, 0.0, 0.0);
}
