// Moves each block of keys and values to their places: digits, blocks and keys in order, so the sort is stable.
//
// A workgroup first sorts its block by the digit in workgroup memory, two bits at a time, each by a scan over the lanes. Then
// neighboring lanes write to neighboring places.
#import tcgs::blocks::{SortParams, LANES, ITEMS, BLOCK, block_of, blocks_of, lane_sums, sum_of_lanes}

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> totals: array<u32>;
@group(0) @binding(3) var<storage, read> counters: array<u32>;
@group(0) @binding(4) var<storage, read> keys: array<u32>;
@group(0) @binding(5) var<storage, read> values: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_values: array<u32>;

// The block's items: the digit in the upper half of the word, the position in the block in the lower. One word after every ITEMS
// is unused, so that lanes that read ITEMS items each use different banks.
var<workgroup> items: array<u32, LANES * (ITEMS + 1u)>;
// Of each digit: the place of its first key, less that key's position in the sorted block.
var<workgroup> shifts: array<u32, LANES>;

fn word(position: u32) -> u32 {
    return position + position / ITEMS;
}

// Exclusive sums of four numbers.
fn exclusive(values: vec4u) -> vec4u {
    return vec4u(0u, values.x, values.x + values.y, values.x + values.y + values.z);
}

@compute @workgroup_size(LANES)
fn radix_scatter(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let count = min(counts[params.count_index], params.capacity);
    let block = block_of(group);
    let first = block * BLOCK;
    // Uniform: all invocations of a workgroup return here or none.
    if first >= count {
        return;
    }
    let within = min(count - first, BLOCK);
    let blocks = blocks_of(count);
    for (var k = 0u; k < ITEMS; k++) {
        let i = k * LANES + lane;
        // What is behind the last key has the largest digit and so stays behind it.
        var digit = params.digits - 1u;
        if i < within {
            digit &= keys[first + i] >> params.shift;
        }
        items[word(i)] = (digit << 16u) | i;
    }
    var total = 0u;
    if lane < params.digits {
        total = totals[lane];
    }
    let place = lane_sums(lane, vec2u(total, 0u)).x - total;
    let base = lane * (ITEMS + 1u);
    for (var bit = 0u; params.digits >> bit > 1u; bit += 2u) {
        workgroupBarrier();
        let a = vec4u(items[base], items[base + 1u], items[base + 2u], items[base + 3u]);
        let b = vec4u(items[base + 4u], items[base + 5u], items[base + 6u], items[base + 7u]);
        // The two bits of each item, and a count of each of their values in a byte of its own.
        let bits_a = (a >> vec4u(16u + bit)) & vec4u(3u);
        let bits_b = (b >> vec4u(16u + bit)) & vec4u(3u);
        let one_a = vec4u(1u) << (8u * bits_a);
        let one_b = vec4u(1u) << (8u * bits_b);
        let before_a = exclusive(one_a);
        let before_b = exclusive(one_b) + vec4u(before_a.w + one_a.w);
        let bytes = before_b.w + one_b.w;
        // Counts of the values 0 and 2, and of 1 and 3, 16 bits each.
        let own = vec2u(bytes, bytes >> 8u) & vec2u(0x00ff00ffu);
        let sum = lane_sums(lane, own);
        let all = sum_of_lanes();
        let zeros = all.x & 0xffffu;
        let ones = all.y & 0xffffu;
        let twos = all.x >> 16u;
        // Where the lane's first item of each value goes, 16 bits each.
        let starts = sum - own + vec2u(0u, zeros) + (vec2u(zeros + ones, zeros + ones + twos) << vec2u(16u));
        let start_a = select(vec4u(starts.x), vec4u(starts.y), (bits_a & vec4u(1u)) == vec4u(1u)) >> (8u * (bits_a & vec4u(2u)));
        let start_b = select(vec4u(starts.x), vec4u(starts.y), (bits_b & vec4u(1u)) == vec4u(1u)) >> (8u * (bits_b & vec4u(2u)));
        let to_a = (start_a & vec4u(0xffffu)) + ((before_a >> (8u * bits_a)) & vec4u(0xffu));
        let to_b = (start_b & vec4u(0xffffu)) + ((before_b >> (8u * bits_b)) & vec4u(0xffu));
        items[word(to_a.x)] = a.x;
        items[word(to_a.y)] = a.y;
        items[word(to_a.z)] = a.z;
        items[word(to_a.w)] = a.w;
        items[word(to_b.x)] = b.x;
        items[word(to_b.y)] = b.y;
        items[word(to_b.z)] = b.z;
        items[word(to_b.w)] = b.w;
    }
    if lane < params.digits {
        shifts[lane] = place + counters[lane * blocks + block];
    }
    workgroupBarrier();
    for (var k = 0u; k < ITEMS; k++) {
        let position = k * LANES + lane;
        let digit = items[word(position)] >> 16u;
        if position > 0u && items[word(position - 1u)] >> 16u != digit {
            shifts[digit] -= position;
        }
    }
    workgroupBarrier();
    for (var k = 0u; k < ITEMS; k++) {
        let position = k * LANES + lane;
        if position < within {
            let item = items[word(position)];
            let source = first + (item & 0xffffu);
            let target_place = shifts[item >> 16u] + position;
            sorted_keys[target_place] = keys[source];
            sorted_values[target_place] = values[source];
        }
    }
}
