#define_import_path tcgs::anchor_view

// One view of the anchors. `rotation` holds the rows of the world-to-camera rotation, each with the matching
// translation component in w.
struct View {
    row_x: vec4f,
    row_y: vec4f,
    row_z: vec4f,
    // w is the reciprocal of the scene scale that the networks' distances are divided by
    center: vec4f,
    // fx, fy, cx, cy in pixels
    intrinsics: vec4f,
    // width, height, near plane, unused
    image: vec4f,
    // anchors, capacity in anchors, unused, unused
    counts: vec4u,
}

fn to_camera(view: View, p: vec3f) -> vec3f {
    return vec3f(
        dot(view.row_x.xyz, p) + view.row_x.w,
        dot(view.row_y.xyz, p) + view.row_y.w,
        dot(view.row_z.xyz, p) + view.row_z.w,
    );
}
