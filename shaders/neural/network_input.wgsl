// Gathers the networks' input of each visible anchor, or of each opaque one among them: feature, unit view direction,
// distance in the scene's unit (METHOD.md §2.2; in the published code always the world's), and up to VIEW_DEGREE the direction's
// harmonics of degrees 2 and 3, whose squares sum to one in each degree.
// Column-major: input[row * capacity + column]. A feature value that is not finite reads as zero: it would make
// the gradients of the weights that all anchors share NaN.
#import tcgs::anchor_view::{View, ray_to}
#import tcgs::finite::below
#import tcgs::harmonics::{basis_of_two, basis_of_three}
#import tcgs::model::{FEATURES, LIMIT, ROW}
#import tcgs::permute::part_of

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> list: array<u32>;
@group(0) @binding(2) var<storage, read> positions: array<vec4f>;
@group(0) @binding(3) var<storage, read> rows: array<f32>;
@group(0) @binding(4) var<storage, read_write> input: array<f32>;
#ifdef OPAQUE
// The number of columns, the place of each column's anchor in the list, and from 1 + capacity on the anchors, written here.
@group(0) @binding(5) var<storage, read_write> columns: array<u32>;
#endif

const VIEW_DEGREE: u32 = #{VIEW_DEGREE}u;
// Roots of the whole sphere's angle over the number of harmonics of a degree.
const UNIT_OF_TWO: f32 = 1.5853309190424043;
const UNIT_OF_THREE: f32 = 1.3398491713813503;

@compute @workgroup_size(64)
fn network_input(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let index = part_of(group, groups) * 64u + local;
    let capacity = view.counts.y;
#ifdef OPAQUE
    if index >= columns[0] {
        return;
    }
    let anchor = list[1u + columns[1u + index]];
    columns[1u + capacity + index] = anchor;
#else
    if index >= list[0] {
        return;
    }
    let anchor = list[1u + index];
#endif
    for (var feature = 0u; feature < FEATURES; feature++) {
        let value = rows[anchor * ROW + feature];
        input[feature * capacity + index] = select(0.0, value, below(value, LIMIT));
    }
    let ray = ray_to(view, positions[anchor].xyz);
    let distance = max(length(ray), 1e-12);
    let direction = ray / distance;
    input[FEATURES * capacity + index] = direction.x;
    input[(FEATURES + 1u) * capacity + index] = direction.y;
    input[(FEATURES + 2u) * capacity + index] = direction.z;
    input[(FEATURES + 3u) * capacity + index] = distance * view.center.w;
    if VIEW_DEGREE > 1u {
        let two = basis_of_two(direction);
        for (var i = 0u; i < 5u; i++) {
            input[(FEATURES + 4u + i) * capacity + index] = UNIT_OF_TWO * two[i];
        }
    }
    if VIEW_DEGREE > 2u {
        let three = basis_of_three(direction);
        for (var i = 0u; i < 7u; i++) {
            input[(FEATURES + 9u + i) * capacity + index] = UNIT_OF_THREE * three[i];
        }
    }
}
