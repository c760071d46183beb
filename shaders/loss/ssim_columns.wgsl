// Second half of SSIM's window, along columns; the SSIM map with its derivatives by E[x], E[x^2 + y^2] and E[(x - y)^2]; and of these the
// first half of the window's adjoint, along the same column. The window is symmetric and zero-padded, so it is its own
// adjoint. Also each run's partial SSIM. One channel an invocation.
#import tcgs::index::lane_index
#import tcgs::ssim::{Image, Tail, REACH, STRIDE, BLOCK, counted, four, held, inside, places, run_of, similarity, slide, total}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> moments: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> derivatives: array<vec3f>;
@group(0) @binding(3) var<storage, read_write> losses: array<vec4f>;
#ifdef MASKED
@group(0) @binding(4) var<storage, read> photograph: array<u32>;
#endif

// Whether the pixels of a column count.
fn seen(column: u32, rows: vec4u) -> vec4<bool> {
#ifdef MASKED
    let pixels = rows * image.size.x + column;
    return counted(vec4u(photograph[pixels.x], photograph[pixels.y], photograph[pixels.z], photograph[pixels.w]));
#else
    return counted(rows);
#endif
}

@compute @workgroup_size(64)
fn ssim_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let index = lane_index(group, local);
    let height = image.size.y;
    let run = run_of(image, index, image.size.x, height);
    if run.channel == 3u {
        return;
    }
    let base = places(image, run.channel, vec4u(run.line)).x;
    var xs = Tail();
    var ys = Tail();
    var squares = Tail();
    var differences = Tail();
    var by_mean = Tail();
    var by_squares = Tail();
    var by_difference = Tail();
    var ssim = vec4f(0.0);
    // The adjoint's windows reach REACH beyond the run, and their own windows as far again: five strides before it.
    for (var row = run.first - 2 * REACH; row < run.last + 2 * REACH; row += STRIDE) {
        let rows = four(row);
        let at = base + BLOCK * held(rows, height);
        // Outside the image there is zero, of moments as of derivatives.
        let counts = inside(rows, height);
        let moment = transpose(mat4x4f(moments[at.x], moments[at.y], moments[at.z], moments[at.w]));
        let similar = similarity(
            slide(&xs, select(vec4f(0.0), moment[0], counts)),
            slide(&ys, select(vec4f(0.0), moment[1], counts)),
            slide(&squares, select(vec4f(0.0), moment[2], counts)),
            slide(&differences, select(vec4f(0.0), moment[3], counts)),
        );
        let centers = rows - REACH;
        let counting = seen(run.line, held(centers, height));
        ssim += select(vec4f(0.0), similar.ssim, centers >= vec4i(run.first) & centers < vec4i(run.last) & counting);
        let derived = inside(centers, height) & counting;
        let sums = transpose(mat3x4f(
            slide(&by_mean, select(vec4f(0.0), similar.by_mean, derived)),
            slide(&by_squares, select(vec4f(0.0), similar.by_squares, derived)),
            slide(&by_difference, select(vec4f(0.0), similar.by_difference, derived)),
        ));
        let center = row - 2 * REACH;
        if center >= run.first {
            let to = base + BLOCK * vec4u(four(center));
            derivatives[to.x] = sums[0];
            derivatives[to.y] = sums[1];
            derivatives[to.z] = sums[2];
            derivatives[to.w] = sums[3];
        }
    }
    losses[run.share] = vec4f(total(ssim), 0.0, 0.0, 0.0);
}
