#define_import_path tcgs::anchor_view

// One view of the anchors. The rows are those of the world-to-camera rotation; w is the image of `center`.
struct View {
    row_x: vec4f,
    row_y: vec4f,
    row_z: vec4f,
    // The camera center, rounded; w is the reciprocal of the scene scale that the networks' distances are divided by
    center: vec4f,
    // fx, fy, cx, cy in pixels
    intrinsics: vec4f,
    // width, height, near plane, unused
    image: vec4f,
    // anchors, capacity in anchors, unused, unused
    counts: vec4u,
}

// Camera coordinates of a world point, by its exact difference to the rounded center (`tcgs::view::to_camera`).
fn to_camera(view: View, p: vec3f) -> vec3f {
    let d = p - view.center.xyz;
    return vec3f(dot(view.row_x.xyz, d), dot(view.row_y.xyz, d), dot(view.row_z.xyz, d))
        + vec3f(view.row_x.w, view.row_y.w, view.row_z.w);
}

// From the camera to a world point, in world axes.
fn ray_to(view: View, p: vec3f) -> vec3f {
    let t = to_camera(view, p);
    return t.x * view.row_x.xyz + t.y * view.row_y.xyz + t.z * view.row_z.xyz;
}
