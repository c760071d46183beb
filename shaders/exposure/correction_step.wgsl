// One Adam step (METHOD.md §2.5) of the correction of a photograph, after which the mean of all corrections is the identity again
// (METHOD.md §2.11). One workgroup, whose sums have a fixed order. If the forward pass overflowed, all is left untouched.
#import tcgs::finite::each_below

const LANES: u32 = 64u;

struct Settings {
    // photographs, the step's photograph, partial sums of the gradient, unused
    shape: vec4u,
    // beta1, beta2, 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t)
    moments: vec4f,
    // epsilon, 1 - beta1, 1 - beta2, learning rate
    extra: vec4f,
}

@group(0) @binding(0) var<uniform> settings: Settings;
@group(0) @binding(1) var<storage, read> partial_sums: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> rows: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> first: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> second: array<vec4f>;
// Not 0 once a forward pass has overflowed: the step is repeated.
@group(0) @binding(5) var<storage, read> overflow_flag: array<u32>;

var<workgroup> lane_sums: array<mat3x4f, LANES>;

// The sum over all lanes. Waits for the lanes before and after.
fn total(local: u32, value: mat3x4f) -> mat3x4f {
    lane_sums[local] = value;
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if local < reach {
            lane_sums[local] += lane_sums[local + reach];
        }
        workgroupBarrier();
    }
    let sum = lane_sums[0];
    workgroupBarrier();
    return sum;
}

fn learn(at: u32, gradient: vec4f) {
    let counts = each_below(gradient, 1e18);
    let g = select(vec4f(0.0), gradient, counts);
    let old_m = first[at];
    let old_v = second[at];
    let m = settings.moments.x * old_m + settings.extra.y * g;
    let v = settings.moments.y * old_v + settings.extra.z * g * g;
    first[at] = select(old_m, m, counts);
    second[at] = select(old_v, v, counts);
    let scale = sqrt(v) * settings.moments.w + settings.extra.x;
    rows[at] -= select(vec4f(0.0), settings.extra.w * (m * settings.moments.z) / scale, counts);
}

@compute @workgroup_size(LANES)
fn correction_step(@builtin(local_invocation_index) local: u32) {
    let learns = overflow_flag[0] == 0u;
    var sum = mat3x4f();
    for (var i = local; i < settings.shape.z; i += LANES) {
        sum += mat3x4f(partial_sums[3u * i], partial_sums[3u * i + 1u], partial_sums[3u * i + 2u]);
    }
    let gradient = total(local, sum);
    if local < 3u && learns {
        learn(3u * settings.shape.y + local, gradient[local]);
    }
    storageBarrier();
    workgroupBarrier();
    sum = mat3x4f();
    for (var i = local; i < settings.shape.x; i += LANES) {
        sum += mat3x4f(rows[3u * i], rows[3u * i + 1u], rows[3u * i + 2u]);
    }
    let mean = total(local, sum) * (1.0 / f32(settings.shape.x));
    let away = mean - mat3x4f(vec4f(1.0, 0.0, 0.0, 0.0), vec4f(0.0, 1.0, 0.0, 0.0), vec4f(0.0, 0.0, 1.0, 0.0));
    if learns {
        for (var i = local; i < settings.shape.x; i += LANES) {
            rows[3u * i] -= away[0];
            rows[3u * i + 1u] -= away[1];
            rows[3u * i + 2u] -= away[2];
        }
    }
}
