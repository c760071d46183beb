// One Adam step (method.md section 1.6): bias-corrected moments, epsilon outside the root. The learning rate of element i
// is rates[i % rates_len]. A gradient that is not finite, or whose square would not be, leaves its element untouched.

struct Settings {
    // elements, length of the rate table, unused, unused
    shape: vec4u,
    // beta1, beta2, 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t)
    moments: vec4f,
    // epsilon, 1 - beta1, 1 - beta2, unused
    extra: vec4f,
}

@group(0) @binding(0) var<uniform> settings: Settings;
@group(0) @binding(1) var<storage, read> rates: array<f32>;
@group(0) @binding(2) var<storage, read> gradients: array<f32>;
@group(0) @binding(3) var<storage, read_write> values: array<f32>;
@group(0) @binding(4) var<storage, read_write> first: array<f32>;
@group(0) @binding(5) var<storage, read_write> second: array<f32>;

@compute @workgroup_size(64)
fn adam(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = (group.x + group.y * 65535u) * 64u + local;
    if i >= settings.shape.x {
        return;
    }
    let g = gradients[i];
    // Written so that NaN and infinity fail it.
    if !(abs(g) < 1e18) {
        return;
    }
    let m = settings.moments.x * first[i] + settings.extra.y * g;
    let v = settings.moments.y * second[i] + settings.extra.z * g * g;
    first[i] = m;
    second[i] = v;
    let scale = sqrt(v) * settings.moments.w + settings.extra.x;
    values[i] -= rates[i % settings.shape.y] * (m * settings.moments.z) / scale;
}
