// Calls symbol_bits for rows of value, mean, deviation, width.
#import tcgs::gaussian::symbol_bits

@group(0) @binding(0) var<storage, read> rows: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> found: array<vec4f>;

@compute @workgroup_size(64)
fn symbol_bits_probe(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = (group.x + group.y * 65535u) * 64u + local;
    if i < arrayLength(&rows) {
        found[i] = symbol_bits(rows[i].x, rows[i].y, rows[i].z, rows[i].w);
    }
}
