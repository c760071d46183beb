// Sums the bits of the sampled anchors, one workgroup an attribute group, in a fixed order.

const LANES: u32 = 64u;

struct Shape {
    // column capacity of the bits, unused, unused, unused
    room: vec4u,
}

@group(0) @binding(0) var<uniform> shape: Shape;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> bits: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

var<workgroup> shared_sums: array<f32, LANES>;

@compute @workgroup_size(LANES)
fn sum_bits(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let sampled = list[0];
    var sum = 0.0;
    for (var column = local; column < sampled; column += LANES) {
        sum += bits[group.x * shape.room.x + column];
    }
    shared_sums[local] = sum;
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if local < reach {
            shared_sums[local] += shared_sums[local + reach];
        }
        workgroupBarrier();
    }
    if local == 0u {
        sums[group.x] = shared_sums[0];
    }
}
