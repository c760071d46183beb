// The gradient of the image loss by each rendered sample: L1's sign, and SSIM's through the second half of the window's
// adjoint, along rows (METHOD.md §2.4). The fourth component, the gradient by alpha, stays zero. Also each run's
// share of L1 and of the squared error. One channel an invocation.
#import tcgs::index::lane_index
#import tcgs::ssim::{Image, Tail, REACH, STRIDE, BLOCK, counted, four, held, inside, places, run_of, runs, slide, total, unpack}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<f32>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read> derivatives: array<vec3f>;
@group(0) @binding(4) var<storage, read_write> losses: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> d_image: array<f32>;

@compute @workgroup_size(64)
fn image_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    let width = image.size.x;
    let run = run_of(image, index, image.size.y, width);
    if run.channel == 3u {
        return;
    }
    var by_mean = Tail();
    var by_squares = Tail();
    var by_difference = Tail();
    var absolute = vec4f(0.0);
    var squared = vec4f(0.0);
    // Starts a whole number of strides before the run, so that the sums are complete at its begin.
    for (var column = run.first + REACH - 3 * STRIDE; column < run.last + REACH; column += STRIDE) {
        let columns = four(column);
        let at = places(image, run.channel, held(columns, width)) + run.line * BLOCK;
        // Outside the image there is zero.
        let counts = inside(columns, width);
        let d = transpose(mat4x3f(derivatives[at.x], derivatives[at.y], derivatives[at.z], derivatives[at.w]));
        let mean = slide(&by_mean, select(vec4f(0.0), d[0], counts));
        let square = slide(&by_squares, select(vec4f(0.0), d[1], counts));
        let apart = slide(&by_difference, select(vec4f(0.0), d[2], counts));
        let center = column - REACH;
        if center >= run.first {
            let pixels = run.line * width + held(four(center), width);
            let to = 4u * pixels + run.channel;
            let packed = vec4u(photograph[pixels.x], photograph[pixels.y], photograph[pixels.z], photograph[pixels.w]);
            let x = vec4f(render[to.x], render[to.y], render[to.z], render[to.w]);
            let y = unpack(packed, run.channel);
            let seen = counted(packed);
            let difference = select(vec4f(0.0), x - y, inside(four(center), width) & seen);
            absolute += abs(difference);
            squared += difference * difference;
            let d_ssim = mean + 2.0 * (x * square + (x - y) * apart);
            let gradient = select(vec4f(0.0), image.weights.x * sign(difference) - image.weights.y * d_ssim, seen);
            d_image[to.x] = gradient.x;
            if center + 1 < run.last {
                d_image[to.y] = gradient.y;
            }
            if center + 2 < run.last {
                d_image[to.z] = gradient.z;
            }
            if center + 3 < run.last {
                d_image[to.w] = gradient.w;
            }
        }
    }
    // After the shares of SSIM.
    losses[3u * image.size.x * runs(image, image.size.y) + run.share] = vec4f(0.0, total(absolute), total(squared), 0.0);
}
