// Sums the partial losses in runs; the host adds the runs. A run on hardware is short, since its lanes wait for their reads in turn.
#import tcgs::index::group_index
#import tcgs::ssim::Image

const LANES: u32 = 64u;
#ifdef SOFTWARE
const RUN: u32 = 4096u;
#else
const RUN: u32 = 512u;
#endif

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> losses: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> sums: array<vec4f>;

var<workgroup> shared_sums: array<vec4f, LANES>;

@compute @workgroup_size(LANES)
fn sum_losses(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let run = group_index(group);
    let last = min((run + 1u) * RUN, image.size.w);
    var sum = vec4f(0.0);
    for (var share = run * RUN + local; share < last; share += LANES) {
        sum += losses[share];
    }
    shared_sums[local] = sum;
    workgroupBarrier();
    for (var reach = LANES / 2u; reach > 0u; reach /= 2u) {
        if local < reach {
            shared_sums[local] += shared_sums[local + reach];
        }
        workgroupBarrier();
    }
    if local == 0u && run < arrayLength(&sums) {
        sums[run] = shared_sums[0];
    }
}
