// First half of SSIM's window: along rows, the moments x, y, x^2 + y^2 and (x - y)^2 of render and photograph, one channel
// an invocation. The squares are needed only as their sum.
#import tcgs::index::lane_index
#import tcgs::ssim::{Image, Tail, REACH, STRIDE, BLOCK, counted, four, held, inside, places, run_of, slide, unpack}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<f32>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec4f>;

@compute @workgroup_size(64)
fn ssim_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let width = image.size.x;
    let run = run_of(image, lane_index(group, local), image.size.y, width);
    if run.channel == 3u {
        return;
    }
    var xs = Tail();
    var ys = Tail();
    var squares = Tail();
    var differences = Tail();
    // Starts a whole number of strides before the run, so that the sums are complete at its begin.
    for (var column = run.first + REACH - 3 * STRIDE; column < run.last + REACH; column += STRIDE) {
        let columns = four(column);
        let pixels = run.line * width + held(columns, width);
        let at = 4u * pixels + run.channel;
        let packed = vec4u(photograph[pixels.x], photograph[pixels.y], photograph[pixels.z], photograph[pixels.w]);
        // Outside the image there is zero, and where a pixel does not count.
        let counts = inside(columns, width) & counted(packed);
        let x = select(vec4f(0.0), vec4f(render[at.x], render[at.y], render[at.z], render[at.w]), counts);
        let y = select(vec4f(0.0), unpack(packed, run.channel), counts);
        let sums = transpose(mat4x4f(
            slide(&xs, x),
            slide(&ys, y),
            slide(&squares, x * x + y * y),
            slide(&differences, (x - y) * (x - y)),
        ));
        let center = column - REACH;
        if center >= run.first {
            // Some of the last four may lie beyond the image, but not beyond their block.
            let to = places(image, run.channel, vec4u(four(center))) + run.line * BLOCK;
            moments[to.x] = sums[0];
            moments[to.y] = sums[1];
            moments[to.z] = sums[2];
            moments[to.w] = sums[3];
        }
    }
}
