#define_import_path tcgs::plain

// Plain Gaussians as they are trained, in four blocks of rows: base values, then the coefficients of degree one, two
// and three, red, green, blue of each in turn. The three blocks of coefficients follow one another in one buffer.
const BASE: u32 = 14u;
const LOG_SCALE: u32 = 3u;
const QUAT: u32 = 6u;
const OPACITY: u32 = 10u;
const COLOR: u32 = 11u;
const BAND_VALUES: vec3u = vec3u(9u, 15u, 21u);

// Degree of spherical harmonics in use; bands above it are neither read nor written.
const DEGREE: u32 = #{DEGREE}u;

// Gaussians of lower opacity reach no pixel.
const ALPHA_MIN: f32 = 1.0 / 255.0;

// One view of the Gaussians.
struct View {
    // Rows of the world-to-camera rotation; w is the image of `eye`.
    right: vec4f,
    down: vec4f,
    forward: vec4f,
    // The camera center, rounded; w is the near plane.
    eye: vec4f,
    // Half the width and height of the image in pixels.
    half_size: vec2f,
    // Gaussians.
    count: u32,
    unused: u32,
}

// Camera coordinates of a world point, by its exact difference to the rounded center (`tcgs::view::to_camera`).
fn to_camera(view: View, mean: vec3f) -> vec3f {
    let d = mean - view.eye.xyz;
    return vec3f(dot(view.right.xyz, d), dot(view.down.xyz, d), dot(view.forward.xyz, d))
        + vec3f(view.right.w, view.down.w, view.forward.w);
}

// From the camera to a world point, in world axes.
fn ray_to(view: View, mean: vec3f) -> vec3f {
    let t = to_camera(view, mean);
    return t.x * view.right.xyz + t.y * view.down.xyz + t.z * view.forward.xyz;
}

// Where the coefficients of a Gaussian begin in each block.
fn bands_at(view: View, gaussian: u32) -> vec3u {
    return view.count * vec3u(0u, BAND_VALUES.x, BAND_VALUES.x + BAND_VALUES.y) + gaussian * BAND_VALUES;
}
