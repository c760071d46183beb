// Verifies what kernels rely on where subgroups may be wider than a workgroup: that a workgroup of LANES invocations occupies
// the first LANES lanes of one subgroup, in order.

const LANES: u32 = #{LANES}u;

// By invocation: a value from the lane that mirrors its own, the sum over all lanes, and the ballot of every third.
@group(0) @binding(0) var<storage, read_write> found: array<vec4u>;

@compute @workgroup_size(LANES)
fn subgroup_probe(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) local: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let own = group.x * LANES + local;
    let mirrored = subgroupShuffle(own, LANES - 1u - lane);
    var sum = own;
    for (var stride = 1u; stride < LANES; stride *= 2u) {
        sum += subgroupShuffleXor(sum, stride);
    }
    let ballot = subgroupBallot(local % 3u == 0u);
    found[own] = vec4u(mirrored, sum, ballot.xy);
}
