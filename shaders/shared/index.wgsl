#define_import_path tcgs::index

// Linear indices. A dispatch of more than 65535 workgroups has them in two dimensions.

fn group_index(group: vec3u) -> u32 {
    return group.x + group.y * 65535u;
}

// Of an invocation of a kernel with workgroups of 64.
fn lane_index(group: vec3u, local: u32) -> u32 {
    return group_index(group) * 64u + local;
}
