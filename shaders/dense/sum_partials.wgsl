// Adds the runs' partial sums of every parameter in a fixed order: every fourth run, then the four sums.

#import tcgs::index::lane_index
#import tcgs::runs::run_length

struct Shape {
    // parameters, unused
    shape: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn sum_partials(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let parameter = lane_index(group, local);
    let stride = shape.shape.x;
    if parameter >= stride {
        return;
    }
    let length = run_length(list[0]);
    let runs = (list[0] + length - 1u) / length;
    var sum = vec4f(0.0);
    var run = 0u;
    // Four reads at a time, since each waits for memory.
    for (; run + 4u <= runs; run += 4u) {
        let i = run * stride + parameter;
        sum += vec4f(partials[i], partials[i + stride], partials[i + 2u * stride], partials[i + 3u * stride]);
    }
    for (; run < runs; run++) {
        sum.x += partials[run * stride + parameter];
    }
    sums[parameter] = (sum.x + sum.y) + (sum.z + sum.w);
}
