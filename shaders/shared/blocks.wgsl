#define_import_path tcgs::blocks

#import tcgs::index::group_index

// Hardware's kernels that sort, scan and list give each workgroup a block of consecutive elements.
const LANES: u32 = 256u;
// Elements of a lane.
const ITEMS: u32 = 8u;
const BLOCK: u32 = LANES * ITEMS;

// One pass of a sort.
struct SortParams {
    // Element of the counts that holds the number of keys, and the largest number.
    count_index: u32,
    capacity: u32,
    // The pass sorts by the digit (key >> shift) % digits.
    shift: u32,
    digits: u32,
}

struct ScanParams {
    // Element of the counts that holds the number of values, and the largest number.
    count_index: u32,
    capacity: u32,
    // Element of the totals that receives the sum.
    total_index: u32,
    unused: u32,
}

// The block of a workgroup; workgroups are spread over two dimensions.
fn block_of(group: vec3u) -> u32 {
    return group_index(group);
}

// Blocks of `count` elements.
fn blocks_of(count: u32) -> u32 {
    return (count + BLOCK - 1u) / BLOCK;
}

// Two copies, written in turns, so that each step of a scan needs one barrier. The first copy holds the result.
var<workgroup> sums: array<vec2u, 2u * LANES>;

// Inclusive sums over the lanes. All lanes call it; a barrier lies between the last use of a result and the next call.
fn lane_sums(lane: u32, own: vec2u) -> vec2u {
    var sum = own;
    var copy = 0u;
    for (var reach = 1u; reach < LANES; reach *= 2u) {
        sums[copy + lane] = sum;
        workgroupBarrier();
        if lane >= reach {
            sum += sums[copy + lane - reach];
        }
        copy = LANES - copy;
    }
    // Eight steps: the last one read the second copy.
    sums[lane] = sum;
    workgroupBarrier();
    return sum;
}

// As `lane_sums`, with sums that saturate.
fn saturating_lane_sums(lane: u32, own: vec2u) -> vec2u {
    var sum = own;
    var copy = 0u;
    for (var reach = 1u; reach < LANES; reach *= 2u) {
        sums[copy + lane] = sum;
        workgroupBarrier();
        if lane >= reach {
            sum = saturating_add(sum, sums[copy + lane - reach]);
        }
        copy = LANES - copy;
    }
    sums[lane] = sum;
    workgroupBarrier();
    return sum;
}

// The sum over all lanes of the last scan.
fn sum_of_lanes() -> vec2u {
    return sums[LANES - 1u];
}

// The sum over the lanes before this one of the last scan.
fn sum_before(lane: u32) -> vec2u {
    return select(sums[max(lane, 1u) - 1u], vec2u(0u), lane == 0u);
}

fn saturating_add(a: vec2u, b: vec2u) -> vec2u {
    let sum = a + b;
    return select(sum, vec2u(0xffffffffu), sum < a);
}
