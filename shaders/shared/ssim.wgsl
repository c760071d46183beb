#define_import_path tcgs::ssim

// The 11-tap Gaussian window of SSIM, sigma 1.5, normalised (method.md section 1.5); symmetric, centre last.
const REACH: i32 = 5;
const TAPS: array<f32, 6> = array<f32, 6>(
    0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
);

struct Image {
    // width, height, unused, unused
    size: vec4u,
    // weight of L1 a sample, weight of SSIM a sample, unused, unused
    weights: vec4f,
}

fn tap(offset: i32) -> f32 {
    return TAPS[REACH - abs(offset)];
}

fn unpack_rgb(packed: u32) -> vec3f {
    return unpack4x8unorm(packed).xyz;
}
