// The input of the context networks for each sampled anchor, column-major: bilinear samples of the three planes at the
// anchor's neighbors (itself first), then its position prior (METHOD.md §4.3, §4.4). An invocation
// computes one plane's samples at one neighbor, or the prior, of one anchor. A texel's position and fraction are integers
// of the decoder's arithmetic, so training samples exactly where the decoder does.
#import tcgs::context::{PRIORS, corners, sample_weights}
#import tcgs::permute::part_of

struct Sampling {
    // edge of a plane, channels of a plane, neighbors that are sampled, columns of a row
    shape: vec4u,
    // first plane value, unused
    first: vec4u,
}

@group(0) @binding(0) var<uniform> sampling: Sampling;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> neighbors: array<u32>;
@group(0) @binding(3) var<storage, read> texels: array<u32>;
@group(0) @binding(4) var<storage, read> priors: array<f32>;
@group(0) @binding(5) var<storage, read> planes: array<f32>;
@group(0) @binding(6) var<storage, read_write> results: array<f32>;

@compute @workgroup_size(64)
fn context_input(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let edge = sampling.shape.x;
    let channels = sampling.shape.y;
    let sampled = sampling.shape.z;
    let capacity = sampling.shape.w;
    let parts = 3u * sampled + 1u;
    let block = part_of(group, groups);
    let strip = block / parts;
    let part = block - strip * parts;
    let column = strip * 64u + local;
    if column >= list[0] {
        return;
    }
    let anchor = list[1u + column];
    if part == 3u * sampled {
        for (var i = 0u; i < PRIORS; i++) {
            results[(part * channels + i) * capacity + column] = priors[anchor * PRIORS + i];
        }
        return;
    }
    let slot = part / 3u;
    let plane = part - 3u * slot;
    let neighbor = neighbors[anchor * sampled + slot];
    let texel = texels[neighbor * 3u + plane];
    let at = corners(texel, edge);
    let weights = sample_weights(texel);
    for (var channel = 0u; channel < channels; channel++) {
        let places = sampling.first.x + (plane * channels + channel) * edge * edge + at;
        let values = vec4f(planes[places.x], planes[places.y], planes[places.z], planes[places.w]);
        results[(part * channels + channel) * capacity + column] = dot(weights, values);
    }
}
