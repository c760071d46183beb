// One Adam step (METHOD.md §2.5): bias-corrected moments, epsilon outside the root. The learning rate of element i
// is rates[i % rates_len]. A gradient that is not finite, or whose square would not be, leaves its element
// untouched. If the forward pass overflowed, all are left untouched.
//
// An invocation updates four neighbors, so that they share one remainder: lanes divide integers one after the other.
// Buffers end on 16 bytes, so the last four may reach past the elements but not past the buffer. What is there does not change.

#import tcgs::finite::each_below
#import tcgs::index::lane_index

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
@group(0) @binding(2) var<storage, read> gradients: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> values: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> first: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> second: array<vec4f>;
// Not 0 once a forward pass has overflowed: the step is repeated.
@group(0) @binding(6) var<storage, read> overflow_flag: array<u32>;

fn after(column: u32) -> u32 {
    return select(column + 1u, 0u, column + 1u == settings.shape.y);
}

fn rates_from(element: u32) -> vec4f {
    let a = element % settings.shape.y;
    let b = after(a);
    let c = after(b);
    let d = after(c);
    return vec4f(rates[a], rates[b], rates[c], rates[d]);
}

@compute @workgroup_size(64)
fn adam(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let i = lane_index(group, local);
    if 4u * i >= settings.shape.x || overflow_flag[0] != 0u {
        return;
    }
    let gradient = gradients[i];
    // The square of anything larger overflows f32. What is behind the last element has gradients that are not this step's.
    let within = vec4u(4u * i) + vec4u(0u, 1u, 2u, 3u) < vec4u(settings.shape.x);
    let counts = each_below(gradient, 1e18) & within;
    let g = select(vec4f(0.0), gradient, counts);
    let old_m = first[i];
    let old_v = second[i];
    let m = settings.moments.x * old_m + settings.extra.y * g;
    let v = settings.moments.y * old_v + settings.extra.z * g * g;
    first[i] = select(old_m, m, counts);
    second[i] = select(old_v, v, counts);
    let scale = sqrt(v) * settings.moments.w + settings.extra.x;
    let step = rates_from(4u * i) * (m * settings.moments.z) / scale;
    values[i] -= select(vec4f(0.0), step, counts);
}
