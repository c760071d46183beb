// Adds the runs' partial sums of every parameter in run order.

struct Shape {
    // parameters, columns a run, unused, unused
    shape: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn sum_partials(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let parameter = (group.x + group.y * 65535u) * 64u + local;
    if parameter >= shape.shape.x {
        return;
    }
    let runs = (list[0] + shape.shape.y - 1u) / shape.shape.y;
    var sum = 0.0;
    for (var run = 0u; run < runs; run++) {
        sum += partials[run * shape.shape.x + parameter];
    }
    sums[parameter] = sum;
}
