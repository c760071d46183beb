#define_import_path tcgs::harmonics

// Constants of the real spherical harmonics, by degree.
const SH_ZERO: f32 = 0.28209479177387814;
const SH_ONE: f32 = 0.4886025119029199;
const SH_TWO: vec3f = vec3f(1.0925484305920792, 0.31539156525252005, 0.5462742152960396);
const SH_THREE_OUTER: vec2f = vec2f(0.5900435899266435, 2.890611442640554);
const SH_THREE_INNER: vec3f = vec3f(0.4570457994644658, 0.3731763325901154, 1.445305721320277);

// The basis functions of one degree at the unit vector d.
fn basis_of_one(d: vec3f) -> vec3f {
    return SH_ONE * vec3f(-d.y, d.z, -d.x);
}

fn basis_of_two(d: vec3f) -> array<f32, 5> {
    let s = d * d;
    return array<f32, 5>(
        SH_TWO.x * d.x * d.y,
        -SH_TWO.x * d.y * d.z,
        SH_TWO.y * (2.0 * s.z - s.x - s.y),
        -SH_TWO.x * d.x * d.z,
        SH_TWO.z * (s.x - s.y),
    );
}

fn basis_of_three(d: vec3f) -> array<f32, 7> {
    let s = d * d;
    return array<f32, 7>(
        -SH_THREE_OUTER.x * d.y * (3.0 * s.x - s.y),
        SH_THREE_OUTER.y * d.x * d.y * d.z,
        -SH_THREE_INNER.x * d.y * (4.0 * s.z - s.x - s.y),
        SH_THREE_INNER.y * d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y),
        -SH_THREE_INNER.x * d.x * (4.0 * s.z - s.x - s.y),
        SH_THREE_INNER.z * d.z * (s.x - s.y),
        -SH_THREE_OUTER.x * d.x * (s.x - 3.0 * s.y),
    );
}

// Gradients of sum(weight * basis function) of one degree by d, which is not constrained to the unit sphere.
fn slope_of_one(w: vec3f) -> vec3f {
    return SH_ONE * vec3f(-w.z, -w.x, w.y);
}

fn slope_of_two(d: vec3f, w: array<f32, 5>) -> vec3f {
    let across = SH_TWO.y * w[2];
    return vec3f(
        SH_TWO.x * (d.y * w[0] - d.z * w[3]) + 2.0 * d.x * (SH_TWO.z * w[4] - across),
        SH_TWO.x * (d.x * w[0] - d.z * w[1]) - 2.0 * d.y * (SH_TWO.z * w[4] + across),
        4.0 * across * d.z - SH_TWO.x * (d.y * w[1] + d.x * w[3]),
    );
}

fn slope_of_three(d: vec3f, w: array<f32, 7>) -> vec3f {
    let s = d * d;
    let outer = 3.0 * SH_THREE_OUTER.x;
    let inner = SH_THREE_INNER;
    return vec3f(
        outer * (-2.0 * d.x * d.y * w[0] - (s.x - s.y) * w[6]) + SH_THREE_OUTER.y * d.y * d.z * w[1]
            + inner.x * (2.0 * d.x * d.y * w[2] - (4.0 * s.z - 3.0 * s.x - s.y) * w[4])
            - 6.0 * inner.y * d.x * d.z * w[3] + 2.0 * inner.z * d.x * d.z * w[5],
        outer * (2.0 * d.x * d.y * w[6] - (s.x - s.y) * w[0]) + SH_THREE_OUTER.y * d.x * d.z * w[1]
            + inner.x * (2.0 * d.x * d.y * w[4] - (4.0 * s.z - s.x - 3.0 * s.y) * w[2])
            - 6.0 * inner.y * d.y * d.z * w[3] - 2.0 * inner.z * d.y * d.z * w[5],
        SH_THREE_OUTER.y * d.x * d.y * w[1] - 8.0 * inner.x * d.z * (d.y * w[2] + d.x * w[4])
            + inner.y * (6.0 * s.z - 3.0 * s.x - 3.0 * s.y) * w[3] + inner.z * (s.x - s.y) * w[5],
    );
}
