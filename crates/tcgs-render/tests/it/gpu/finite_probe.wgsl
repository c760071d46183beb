// Answers of the tests for numbers that are none, for each value with a limit.
#import tcgs::finite::{all_finite, below, each_below, finite}

@group(0) @binding(0) var<storage, read> rows: array<vec2f>;
@group(0) @binding(1) var<storage, read_write> found: array<vec4u>;

@compute @workgroup_size(64)
fn finite_probe(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = (group.x + group.y * 65535u) * 64u + local;
    if i < arrayLength(&rows) {
        let value = rows[i].x;
        let limit = rows[i].y;
        let spread = vec4f(1.0, value, -1.0, 0.0);
        found[i] = vec4u(
            u32(finite(value)),
            u32(all_finite(spread)),
            u32(below(value, limit)),
            u32(each_below(vec4f(0.0, 0.0, value, 0.0), limit).z),
        );
    }
}
